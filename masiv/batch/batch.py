"""Run a batch: read its spec, run what is missing, write the table and the page."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

from masiv.batch.engine import engine
from masiv.batch.plan import stages_of
from masiv.batch.run import RECORD, run_stages
from masiv.batch.spec import jobs_of, overridden, read_spec
from masiv.batch.table import PAGE, TABLE, as_text, rows_of, write_page, write_table
from masiv.cores import available_cores
from masiv.errors import InputError
from masiv.folder_lock import locked
from masiv.pipeline.requests import Overrides, Summary
from masiv.progress import Progress, silent


def run_batch(
    path: Path,
    out: Path | None = None,
    *,
    workers: int | None = None,
    threads: int | None = None,
    scheduler: str | None = None,
    overrides: Overrides | None = None,
    dry_run: bool = False,
    progress: Progress = silent,
) -> Summary:
    """Run the batch of the spec in ``path``.

    out: its folder (None: the spec's name in the current folder). workers: stages at a time on this machine (None: one
    for each core, or as many as there are runs); threads: of each stage (None: the cores shared between the workers).
    scheduler: address of a Dask scheduler, whose workers run the stages in place of this machine; they must see the
    same files. overrides: of all runs; a seed takes the place of the spec's. dry_run: only say what would run. A second
    call runs what is missing.

    Runs that failed are in the result, with the reason. Raises InputError for a spec that is not valid.
    """
    given = overrides or Overrides()
    spec = overridden(read_spec(path), preset=given.preset, config=given.config, seed=given.seed)
    jobs = jobs_of(spec, path.resolve().parent, path, given.assignments)
    folder = (out or Path(path.stem)).resolve()
    stages = stages_of(spec, jobs, folder, given.arch)
    if dry_run:
        lines = [" ".join(("masiv", *stage.command)) for stage in stages]
        return Summary({"out": str(folder), "commands": [list(stage.command) for stage in stages]}, "\n".join(lines))
    cores = available_cores()
    count = workers or min(cores, len(jobs))
    if (
        folder.exists()
        and not (folder / RECORD).exists()
        and any(not p.name.startswith("lock") for p in folder.iterdir())
    ):
        raise InputError(f"{folder} exists and holds no batch: give another folder with --out")
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder), engine(count, scheduler) as executor:
        record = run_stages(stages, folder, executor, threads or max(1, cores // count), progress)
    rows = rows_of(jobs, stages, record.stages)
    write_table(rows, folder / TABLE)
    reports = {
        job.name: quote(f"runs/{job.name}/report.html")
        for job in jobs if (folder / "runs" / job.name / "report.html").is_file()
    }  # fmt: skip
    write_page(path.stem, rows, folder / PAGE, reports)
    data = {"out": str(folder), "table": str(folder / TABLE), "page": str(folder / PAGE), "runs": rows}
    return Summary(data, f"{as_text(rows)}\ntable    {folder / TABLE}\npage     {folder / PAGE}")
