"""One process at a time changes a folder; the lock of a dead one is taken over."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest

from masiv.errors import InputError
from masiv.folder_lock import LOCK_FILE, STALE_S, Holder, locked

HOLD = """
import sys
from pathlib import Path
from masiv.folder_lock import locked
with locked(Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the lock of ``tmp_path``."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.communicate()


def written(folder, **changes):
    """A lock of this process, with ``changes``."""
    (folder / LOCK_FILE).write_text(json.dumps({**vars(Holder.this_process()), **changes}))


def taken(folder) -> bool:
    with locked(folder) as taken_over:
        return taken_over


def test_another_process_is_refused_and_told_who_it_is(tmp_path, holder):
    with pytest.raises(InputError, match=f"in use by .*process {holder.pid} of .* since 20"), locked(tmp_path):
        pass
    holder.communicate("")
    assert os.listdir(tmp_path) == []
    assert not taken(tmp_path)
    assert os.listdir(tmp_path) == []


def test_the_lock_of_a_killed_process_is_taken_over_with_a_word(tmp_path, holder):
    """Also while its parent, this process, has not noticed its end (a zombie)."""
    holder.send_signal(signal.SIGKILL)
    os.waitid(os.P_PID, holder.pid, os.WEXITED | os.WNOWAIT)
    with pytest.warns(UserWarning, match=f"process {holder.pid} .* has ended"):
        assert taken(tmp_path)
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells when a process began")
def test_a_process_that_got_the_number_of_a_dead_one_does_not_hold_its_lock(tmp_path):
    written(tmp_path, started=1)
    with pytest.warns(UserWarning, match="has ended"):
        assert taken(tmp_path)


@pytest.mark.parametrize("text", ["host", ""])
def test_another_machine_is_judged_by_its_sign_of_life(tmp_path, text):
    path = tmp_path / LOCK_FILE
    written(tmp_path, host="elsewhere")
    if not text:
        path.write_text(text)  # a lock that cannot be read
    with pytest.raises(InputError, match="in use by"), locked(tmp_path):
        pass
    silent_since = path.stat().st_mtime - STALE_S - 60
    os.utime(path, (silent_since, silent_since))
    with pytest.warns(UserWarning, match="has ended"):
        assert taken(tmp_path)


def test_a_process_may_take_its_lock_twice_and_holds_it_until_the_last_end(tmp_path):
    with locked(tmp_path):
        with locked(tmp_path) as taken_over:
            assert not taken_over
        assert json.loads((tmp_path / LOCK_FILE).read_text())["pid"] == os.getpid()
    assert os.listdir(tmp_path) == []


def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match="cannot be written"), locked(tmp_path / "none"):
        pass
