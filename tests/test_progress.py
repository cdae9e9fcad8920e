"""Progress in a notebook: bars, as on a terminal."""

import pytest

import tilestream as ts
from tilestream.cli import progress as telling
from tilestream.cli.printing import _Console
from tilestream.pipeline.engine.attempt import Outcome


def test_a_notebook_has_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    display = pytest.importorskip("IPython.display")
    pytest.importorskip("ipywidgets")
    shown: list[str] = []
    monkeypatch.setattr(
        display, "display", lambda one, **_: shown.append(str(getattr(one, "html", "")))
    )
    monkeypatch.setattr(telling, "err", _Console(stderr=True, force_jupyter=True))
    with ts.progress() as watch:
        watch(Outcome("merge-0_0", "merge"), 1, 3)
        watch(Outcome("merge-0_1", "merge", reason="a lost disk"), 2, 3)
    page = "".join(shown)
    assert "merge" in page
    assert "2/3" in page
    assert "a lost disk" in page


def test_elsewhere_it_tells_lines_and_failures(capsys: pytest.CaptureFixture[str]) -> None:
    with ts.progress() as watch:
        watch(Outcome("merge-0_1", "merge", reason="a lost disk"), 2, 3)
    assert "failed merge-0_1: a lost disk" in capsys.readouterr().err


def test_equal_failures_are_told_once_and_what_was_not_run_is_no_failure(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with ts.progress() as watch:
        for tile in ("0_1", "0_2", "0_3"):
            watch(Outcome(f"merge-{tile}", "merge", reason="a lost disk"), 1, 3)
            not_run = f"not run, since merge-{tile} failed: a lost disk"
            watch(Outcome(f"cells-{tile}", "cells", reason=not_run), 1, 3)
        watch(Outcome("merge-0_4", "merge", reason="cut short"), 4, 4)
    told = capsys.readouterr().err.splitlines()
    assert told == ["failed merge-0_1: a lost disk", "failed merge-0_4: cut short"]
