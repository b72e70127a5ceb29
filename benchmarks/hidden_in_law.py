"""Does a fitted law absorb an effect, and does refine prevent it? One material, with and without drag.

    python benchmarks/hidden_in_law.py

Laws are fitted to simulated motions of one elastic body (tracks with correlated noise of 2 mm): without drag; with
drag that the model does not have; and to the latter again with the effect that refine found. A law that absorbed the
drag has other stresses over the observed strains. Printed: RMS differences of Kirchhoff stress in percent of that of
another law, over the deformation gradients that the true body reaches in the fitted frames, with and without pressure,
and in uniaxial tension and compression; and the error of the motion.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
FRAMES, STRAIN = 12, 0.12


def main():
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    import torch
    from refine_tracks import ELASTIC, quiet
    from track_cases import Case, observed

    from masiv import runtime
    from masiv.config import load_config
    from masiv.identification.stage import identify, relearn
    from masiv.materials.classical import ClassicalLaw
    from masiv.observations.motion import SampledMotion
    from masiv.refinement.config import RefineConfig
    from masiv.refinement.document import document as document_of
    from masiv.refinement.from_video import Recording, refine_recordings
    from masiv.refinement.to_twin import refined_twin

    runtime.start("cpu")
    torch.set_num_threads(1)
    settings = load_config(preset="quick")
    config = settings.identify.model_copy(update={"pictures": 0, "contact": "sticky"})
    kind, parameters = ELASTIC
    laws, errors = {"truth": ClassicalLaw(kind, **parameters)}, {}

    def cut(scene, motion):
        return replace(scene, frame_count=FRAMES), SampledMotion(
            motion.positions[:FRAMES], motion.times[:FRAMES], motion.volume
        )

    for name, effects in (("no drag", {}), ("drag, not in the model", {"linear_drag": {"rate": 0.8}})):
        scene, motion = observed(Case(name, kind, parameters, effects, seed=5))
        seen, fitted = cut(scene, motion)
        twin = identify(seen, fitted, config, settings.simulator, seed=0, progress=quiet)
        laws[name], errors[name] = twin.law, twin.fit["trajectory_error_mm"]
    wanted = RefineConfig.model_validate({"particles": 800, "laws": [kind]})
    recording = Recording("drag", scene, fitted, motion, FRAMES)
    result = refine_recordings([recording], config, settings.simulator, wanted, progress=quiet)
    document = document_of(result)
    print("refine:", document["verdict"], [(a["effect"], a["theta"], a["stderr"]) for a in document["accepted"]])
    refined = refined_twin(twin, result)
    laws["drag, refine's classical law"] = refined.law
    again = relearn(refined, seen, fitted, config, seed=0, progress=quiet)
    laws["drag, fitted again with the effect"] = again.law
    errors["drag, fitted again with the effect"] = again.fit["trajectory_error_mm"]

    gradients = gradients_reached(refined.with_body(law=laws["truth"]))
    with torch.no_grad():
        over = {name: law.stress(gradients).double().numpy() for name, law in laws.items()}
    curves = {name: stresses(law) for name, law in laws.items()}
    print("RMS difference of stress, over the deformation gradients reached / without pressure / uniaxial\n")
    print("| law | against that without drag | against the truth | mean distance to the motion [mm] |")
    print("|---|---|---|---|")
    for name, curve in curves.items():
        cells = [
            " / ".join(
                f"{100 * apart(a, b):.1f} %"
                for a, b in (
                    (over[name], over[other]),
                    (deviator(over[name]), deviator(over[other])),
                    (curve, curves[other]),
                )
            )
            for other in ("no drag", "truth")
        ]
        print(f"| {name} | {cells[0]} | {cells[1]} | {errors.get(name, float('nan')):.1f} |")


def gradients_reached(twin):
    """Elastic deformation gradients (M, 3, 3) of all particles at the fitted frames."""
    import torch

    from masiv.simulation.free_body import iterate_states

    return torch.cat([state.trial_gradient for state in iterate_states(twin, frames=FRAMES, fps=twin.fps)])


def stresses(law):
    """Axial Kirchhoff stress [Pa] over strains up to STRAIN in tension and compression, a second there and back."""
    from masiv.characterization.curves import there_and_back, uniaxial

    return np.concatenate([uniaxial(law, there_and_back(s, 20), 0.025).stress for s in (STRAIN, -STRAIN)])


def deviator(stress):
    """Stresses (M, 3, 3) without their pressure."""
    return stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)


def apart(curve, other):
    return float(np.sqrt(((curve - other) ** 2).mean() / (other**2).mean()))


if __name__ == "__main__":
    main()
