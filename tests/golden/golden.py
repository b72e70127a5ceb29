"""Golden results: the numbers of a few small jobs, compared to the last digit.

    python tests/golden/golden.py record [--only NAME] [--jobs 2]
    python tests/golden/golden.py compare [--only NAME] [--jobs 2] [--rtol 1e-3]
    python tests/golden/golden.py run NAME

``record`` writes NAME.json beside this file, ``compare`` exits with 1 if a number differs from it, ``run`` prints the
numbers of one entry. The entries are in entries.py. Each runs in processes of its own, on one thread.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

from entries import ENTRIES

HERE = Path(__file__).resolve().parent
ONE_THREAD = {
    "TI_CPU_MAX_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
MISSING = "missing"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("record", "compare"):
        command = commands.add_parser(name)
        command.add_argument("--only", action="append", choices=list(ENTRIES), help="this entry; may be repeated")
        command.add_argument("--jobs", type=int, default=1, help="entries that run side by side")
        if name == "compare":
            command.add_argument("--rtol", type=float, default=0.0, help="relative tolerance, for another machine")
    commands.add_parser("run").add_argument("name", choices=list(ENTRIES))
    options = parser.parse_args()
    if options.command == "run":
        print(json.dumps(run(options.name)))
        return 0
    failed = False
    with ThreadPoolExecutor(options.jobs) as pool:
        names = options.only or list(ENTRIES)
        for name, result in zip(names, pool.map(run_apart, names), strict=True):
            if isinstance(result, str):
                print(f"{name}: failed\n{result}", flush=True)
                failed = True
            elif options.command == "record":
                record(name, result)
            else:
                failed |= not compare(name, result, options.rtol)
    return int(failed)


def run(name: str) -> dict[str, Any]:
    """The numbers of an entry, and the CPU time of this process and those that it started [s]."""
    with tempfile.TemporaryDirectory() as folder:
        numbers = ENTRIES[name](Path(folder))
    return {"numbers": numbers, "seconds": sum(os.times()[:4])}


def run_apart(name: str) -> dict[str, Any] | str:
    """``run`` in a new process; the end of its stderr if it fails."""
    ended = subprocess.run(
        [sys.executable, __file__, "run", name],
        env={**os.environ, **ONE_THREAD}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return json.loads(ended.stdout.splitlines()[-1]) if ended.returncode == 0 else ended.stderr[-2000:]


def record(name: str, result: dict[str, Any]) -> None:
    """Write NAME.json."""
    count = len(dict(leaves(result["numbers"])))
    text = json.dumps({"platform": this_platform(), "numbers": result["numbers"]}, indent=1)
    (HERE / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    print(f"{name}: recorded, {count} values, {result['seconds']:.0f} s", flush=True)


def compare(name: str, result: dict[str, Any], rtol: float) -> bool:
    """Print how the numbers differ from NAME.json. Returns whether all are equal, or within ``rtol``."""
    path = HERE / f"{name}.json"
    if not path.is_file():
        print(f"{name}: {path.name} is missing: record it first", flush=True)
        return False
    golden = json.loads(path.read_text(encoding="utf-8"))
    was, now = dict(leaves(golden["numbers"])), dict(leaves(result["numbers"]))
    rows = [(p, was.get(p, MISSING), now.get(p, MISSING)) for p in {**was, **now}]
    rows = [row for row in rows if not same(*row, rtol=rtol)]
    here = this_platform()
    for key, value in golden["platform"].items():
        if value != here[key]:
            print(f"{name}: {key}: recorded with {value}, here {here[key]}")
    if not rows:
        how = f"within {rtol:g}" if rtol else "equal"
        print(f"{name}: {how}, {len(was)} values, {result['seconds']:.0f} s", flush=True)
        return bool(was)
    largest = max(difference(a, b) for _, a, b in rows)
    print(f"{name}: {len(rows)} of {len(was)} values differ; largest relative difference of a number {largest:.2g}")
    for p, a, b in rows:
        print(f"  {p}: {a!r} -> {b!r}")
    sys.stdout.flush()
    return False


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Path and value of all that is no container, and of empty containers."""
    if isinstance(value, dict) and value:
        for key, item in value.items():
            yield from leaves(item, f"{path}.{key}" if path else key)
    elif isinstance(value, list) and value:
        for k, item in enumerate(value):
            yield from leaves(item, f"{path}[{k}]")
    else:
        yield path, value


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def same(path: str, was: Any, now: Any, *, rtol: float) -> bool:
    """Whether both are equal. With a tolerance, numbers may differ by ``rtol`` of their size (and by a thousandth of
    ``rtol`` if they are near zero), and hashes are not compared."""
    if is_number(was) and is_number(now):
        return (math.isnan(was) and math.isnan(now)) or math.isclose(was, now, rel_tol=rtol, abs_tol=1e-3 * rtol)
    return was == now or (rtol > 0 and path.endswith(".sha256"))


def difference(was: Any, now: Any) -> float:
    """Relative difference of two numbers; infinite if one is not finite, 0 for what is no number."""
    if not (is_number(was) and is_number(now)):
        return 0.0
    if not (math.isfinite(was) and math.isfinite(now)):
        return math.inf
    return abs(was - now) / max(abs(was), abs(now))


def this_platform() -> dict[str, str]:
    """CPU, Python and the versions of packages on which last digits depend."""
    packages = {name: version(name) for name in ("numpy", "scipy", "taichi", "torch", "opencv-python-headless")}
    system = f"{platform.system()} {platform.machine()}"
    return {"system": system, "cpu": cpu(), "python": platform.python_version(), **packages}


def cpu() -> str:
    """Model of the CPU."""
    info = Path("/proc/cpuinfo")
    if not info.is_file():
        return platform.processor()
    rows = dict(line.split(":", 1) for line in info.read_text().split("\n\n")[0].splitlines() if ":" in line)
    found = {key.strip(): value.strip() for key, value in rows.items()}
    kept = ("model name", "cpu family", "model", "stepping")
    return ", ".join(f"{key} {found[key]}" for key in kept if key in found)


if __name__ == "__main__":
    sys.exit(main())
