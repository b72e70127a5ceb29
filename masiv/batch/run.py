"""Run the stages of a batch in the order in which they depend on each other, and keep a record of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from masiv.batch.plan import Stage
from masiv.batch.process import StageResult, run_stage
from masiv.errors import InputError
from masiv.files import write_json
from masiv.progress import Progress, silent
from masiv.scene.listing import mapping
from masiv.strict import read_json

RECORD, LOGS, STOP = "batch.json", "logs", "stop"
SCHEMA = 1
DONE, FAILED, WAITING = "done", "failed", "waiting"


@dataclass
class Record:
    """batch.json: of each stage its command, state, seconds, host, message and what it printed."""

    path: Path
    stages: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, path: Path) -> Record:
        """The record in ``path``, or a new one. Raises InputError for a file that is none."""
        if not path.exists():
            return cls(path)
        data = mapping(read_json(path), str(path))
        stages = data.get("stages")
        if data.get("schema") != SCHEMA or not isinstance(stages, dict):
            raise InputError(f"{path} is not the record of a batch of this version: give another folder with --out")
        return cls(path, dict(stages))

    def done(self, stage: Stage) -> bool:
        """Whether the stage has ended well, with the same command, and its folder is there."""
        known = self.stages.get(stage.key, {})
        same = known.get("command") == list(stage.command)
        return known.get("state") == DONE and same and (stage.folder / "run.yaml").is_file()

    def note(self, stage: Stage, result: StageResult) -> None:
        self.stages[stage.key] = {
            "command": list(stage.command), "state": FAILED if result.message else DONE,
            "seconds": round(result.seconds, 2), "host": result.host, "message": result.message, "data": result.data,
        }  # fmt: skip
        self.write()

    def write(self) -> None:
        write_json(self.path, {"schema": SCHEMA, "stages": self.stages})


def run_stages(
    stages: Sequence[Stage], out: Path, executor: Executor, threads: int, progress: Progress = silent
) -> Record:
    """Run what the record in ``out`` lacks. A stage that fails does not stop others, but those that wait for it do not
    begin. On an exception, such as Ctrl-C, running stages are asked to stop; they go on from their checkpoints the next
    time."""
    record = Record.of(out / RECORD)
    stop = out / STOP
    stop.unlink(missing_ok=True)
    done: set[str] = set()
    for stage in stages:  # what follows on a stage that runs again does so, too
        if record.done(stage) and done.issuperset(stage.after):
            done.add(stage.key)
    waiting = {stage.key: stage for stage in stages if stage.key not in done}
    for key in waiting:
        record.stages.pop(key, None)
    record.write()
    running: dict[Future[StageResult], Stage] = {}
    progress("batch", len(done), len(stages))
    try:
        while waiting or running:
            for stage in [s for s in waiting.values() if done.issuperset(s.after)]:
                log = out / LOGS / f"{stage.key.replace('/', '.')}.log"
                running[executor.submit(run_stage, stage, threads, log, stop)] = waiting.pop(stage.key)
            if not running:
                break
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                stage = running.pop(future)
                result = _result(future, stage)
                record.note(stage, result)
                if not result.message:
                    done.add(stage.key)
                progress("batch", len(done), len(stages), f"{stage.key}: {result.message or 'done'}")
    except BaseException:
        stop.touch()
        raise
    return record


def _result(future: Future[StageResult], stage: Stage) -> StageResult:
    """What the stage gave; a worker that died, again and again, is a failure of the stage."""
    try:
        return future.result()
    except Exception as error:
        return StageResult(stage.key, 0.0, f"its worker died ({type(error).__name__}: {error})")


def state_of(run_stages_: Sequence[Stage], record: Mapping[str, Mapping[str, Any]]) -> str:
    """Of all stages of a run together."""
    states = [record.get(stage.key, {}).get("state", WAITING) for stage in run_stages_]
    return FAILED if FAILED in states else WAITING if WAITING in states else DONE
