"""A process that is killed in the middle of a job, always at the same task."""

import signal
import subprocess
import sys

CODE = """
import os, signal, sys
import tilestream as ts

left = {count}

def watch(outcome, *_):
    global left
    left -= outcome.stage == {stage!r}
    if not left:
        os.kill(os.getpid(), signal.SIGKILL)

{call}
"""


def killed_after(count: int, stage: str, call: str, *arguments: str) -> None:
    """Run a job in another process until so many tasks of a stage have ended.

    Args:
        count: of the tasks.
        stage: theirs.
        call: Python that runs the job, with `ts`, `sys.argv` and `watch`.
        arguments: `sys.argv[1:]` of the call.
    """
    code = CODE.format(count=count, stage=stage, call=call)
    done = subprocess.run([sys.executable, "-c", code, *arguments])
    assert done.returncode == -signal.SIGKILL, "the job was over before it was killed"
