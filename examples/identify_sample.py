"""Video -> twin: identify the sample scene, then print its law and how far the twin is from the truth.

    python examples/identify_sample.py [--config SETTINGS.yaml] [--out RUN]

About five minutes with the preset quick on two cores.
"""

import argparse
from pathlib import Path

import numpy as np

import masiv
from masiv.pipeline import Overrides

SAMPLE = Path(__file__).parents[1] / "assets" / "sample"


def main(out: Path, config: Path | None) -> dict:
    run = masiv.open_run(SAMPLE, out, Overrides(preset="quick", config=config))
    run.identify()
    twin = masiv.Twin.load(out)
    rollout = np.load(out / "rollout.npz")["positions"]
    errors = masiv.evaluate(rollout, SAMPLE / "gt")
    print("law", twin.law.description()["kind"], "initial velocity [m/s]", np.round(twin.velocity, 2))
    print(f"tracked error {errors['tracked_error_mm']:.1f} mm, Chamfer {errors['chamfer_1e3mm2']:.2f} 10^3 mm^2")
    return errors


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, default=Path("runs/example"))
    parser.add_argument("--config", type=Path)
    options = parser.parse_args()
    main(options.out, options.config)
