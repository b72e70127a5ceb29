"""A twin in situations that were never filmed: on the moon, thrown upwards, without an effect that refine added.

    python examples/simulate_variations.py RUN

RUN is a run folder of ``masiv identify``.
"""

import sys
from pathlib import Path

import numpy as np

import masiv

FRAMES = 12


def main(run: Path) -> dict[str, np.ndarray]:
    twin = masiv.Twin.load(run)
    up = np.asarray(twin.up)
    situations = {
        "as filmed": {},
        "on the moon": {"gravity": -1.62 * up},
        "thrown upwards": {"velocity": 2.0 * up},
        **{f"without {effect.name}": {"without": [effect.name]} for effect in twin.effects},
    }
    heights = {}
    for name, changes in situations.items():
        rollout = masiv.simulate(twin, frames=FRAMES, **changes)
        heights[name] = rollout.positions.mean(1) @ up
        print(f"{name:24s} height of the centroid [m]:", np.round(heights[name], 2))
    return heights


if __name__ == "__main__":
    main(Path(sys.argv[1]))
