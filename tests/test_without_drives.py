"""Whoever has nothing to learn from is told the two ways that need no drives, wherever it shows."""

from pathlib import Path

import pytest
from model_data import dataset

import tilestream as ts
from tilestream.cli import run as command
from tilestream.errors import ModelError, SourceNotFoundError, UsageError
from tilestream.model.dataset import WITHOUT_DRIVES
from tilestream.model.registry import UNTRAINED
from tilestream.pipeline.jobs.estimator import estimator_of
from tilestream.pipeline.jobs.run_settings import RunSettings

JOB = "out: run\nmap: {sources: [a.pcd]}\nroutes: [r.csv]\n"


def names_both(told: object) -> bool:
    return "`tilestream estimate`" in str(told) and f"recipe: {UNTRAINED}" in str(told)


@pytest.mark.parametrize("drives", ["", "drives: []\n", "drives: # - {log: a.mcap}\n"])
def test_a_job_without_drives(
    drives: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("job.yaml").write_text(JOB + drives)
    for verb in ("run", "plan"):
        assert command([verb, "job.yaml"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert names_both(line)
    for job in (ts.run, ts.plan):
        with pytest.raises(UsageError) as told:
            job("job.yaml")
        assert names_both(told.value)
    assert [path.name for path in tmp_path.iterdir()] == ["job.yaml"]


def test_what_is_named_is_a_job_that_can_be() -> None:
    ways = {"model": {"recipe": UNTRAINED}, "drives": None}
    assert RunSettings(out="run", map={"sources": ["a.pcd"]}, **ways).drives == ()


def test_too_few_measured_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tilestream.pipeline.jobs.estimator.is_shipped", lambda: False)
    settings = RunSettings(out="run", map={"sources": ["a.pcd"]}, drives=[{"log": "a.mcap"}])
    assert names_both(estimator_of(settings, 49).few)
    assert estimator_of(settings, 50).few == ""
    few = dataset(lengths={"a": 20})
    with pytest.raises(ModelError) as told:
        few.check()
    assert names_both(told.value)


def test_a_run_that_measured_nothing(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("out: run\n")
    for ask in (ts.dataset, lambda run: ts.train_over({"a": run})):
        with pytest.raises(SourceNotFoundError) as told:
            ask(tmp_path)
        assert names_both(told.value)
    assert names_both(WITHOUT_DRIVES)
