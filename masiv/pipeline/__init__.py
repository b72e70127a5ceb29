"""What the commands do, as functions: open a run folder, run the stages that it lacks, write its artefacts."""

from masiv.pipeline.export import export_results
from masiv.pipeline.requests import Overrides, RefineRequest, SceneRequest, SimulateRequest, Summary, ViewRequest
from masiv.pipeline.run import Run, inspect_scene, open_run, reopen_run

__all__ = [
    "Overrides",
    "RefineRequest",
    "Run",
    "SceneRequest",
    "SimulateRequest",
    "Summary",
    "ViewRequest",
    "export_results",
    "inspect_scene",
    "open_run",
    "reopen_run",
]
