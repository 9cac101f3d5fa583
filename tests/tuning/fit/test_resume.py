"""A run that is killed at any moment goes on and ends where it would have ended."""

import json
import shutil
import signal
import subprocess
import sys
import time

import pytest
import torch
from planted import FIXED, write_planted

import tuning.fit.run
from torchblur.errors import OutputError
from torchblur.io import save_yaml
from torchblur.params import build
from tuning.config.fit import FilterSpec, TuneConfig, load_tune_config
from tuning.config.methods import BlackBoxMethod
from tuning.files.run_folder import RunFolder, open_run, trim_torn_line
from tuning.fit.run import run_fit
from tuning.methods.blackbox import BlackBoxJob, fit_blackbox
from tuning.objective.space import make_space

RUN = """
import sys
from tuning.config.fit import load_tune_config
from tuning.fit.run import run_fit
run_fit(load_tune_config(sys.argv[1]), sys.argv[2], resume=True, progress=lambda e: print(
    e.stage, e.done, flush=True))
"""


class StoppedError(Exception):
    """Stands for a kill between two steps."""


def stop_after(stage, done):
    def watch(event):
        if (event.stage, event.done) == (stage, done):
            raise StoppedError

    return watch


def outcome(result):
    """Return what must not depend on how often a run was stopped."""
    return result.model_dump(exclude={"seconds", "command", "methods"}), [
        method.model_dump(exclude={"seconds", "cpu_seconds", "spent"}) for method in result.methods
    ]


def losses(folder):
    lines = (folder / "log.jsonl").read_text().splitlines()
    records = [json.loads(line) for line in lines]
    return [(r["method"], r["step"], r["loss"], r["params"]) for r in records if "loss" in r]


@pytest.fixture
def config(planted_folders):
    return build(TuneConfig, planted_folders)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that was never stopped: its folder and its result."""
    root = tmp_path_factory.mktemp("whole")
    config = build(TuneConfig, write_planted(root / "frames"))
    return root / "run", run_fit(config, root / "run")


@pytest.mark.parametrize("moment", [("gradient", 1), ("gradient", 4), ("tpe", 3), ("report", 1)])
def test_stopped_between_steps(config, tmp_path, whole, moment):
    with pytest.raises(StoppedError):
        run_fit(config, tmp_path / "run", progress=stop_after(*moment))
    resumed = run_fit(config, tmp_path / "run", resume=True)
    assert outcome(resumed) == outcome(whole[1])
    assert losses(tmp_path / "run") == losses(whole[0])


@pytest.mark.slow
def test_killed_again_and_again(planted_folders, tmp_path):
    """SIGKILL wherever it strikes, in processes of their own."""
    planted_folders["methods"] = [
        {"kind": "gradient", "steps": 10, "starts": 2},
        {"kind": "blackbox", "sampler": "tpe", "trials": 15},
    ]
    save_yaml(tmp_path / "fit.yaml", planted_folders)
    config = load_tune_config(tmp_path / "fit.yaml")
    whole = run_fit(config, tmp_path / "whole")
    for wanted in ("gradient 3", "gradient 9", "tpe 6"):
        _run_until(wanted, tmp_path)
    resumed = run_fit(config, tmp_path / "run", resume=True)
    assert outcome(resumed) == outcome(whole)
    assert losses(tmp_path / "run") == losses(tmp_path / "whole")


def _run_until(wanted, folder):
    """Start a run in a process and kill it a little after it has told a step."""
    command = [sys.executable, "-c", RUN, str(folder / "fit.yaml"), str(folder / "run")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert any(line.strip() == wanted for line in process.stdout)
        time.sleep(0.013)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL


def test_interrupt_leaves_a_run_that_goes_on(config, tmp_path, whole, monkeypatch):
    calls = []
    advance = tuning.methods.gradient_state.AdamState.advance

    def interrupted(state, problem):
        calls.append(state.step)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return advance(state, problem)

    monkeypatch.setattr(tuning.methods.gradient_state.AdamState, "advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_fit(config, tmp_path / "run")
    resumed = run_fit(config, tmp_path / "run", resume=True)
    assert calls == [0, 1, 2, 2, 3]
    assert outcome(resumed) == outcome(whole[1])


def test_killed_between_log_and_checkpoint(config, tmp_path, whole, monkeypatch):
    calls = iter(range(100))
    save_state = RunFolder.save_state

    def save_or_stop(folder, name, state):
        if next(calls) == 2:
            raise StoppedError
        save_state(folder, name, state)

    monkeypatch.setattr(RunFolder, "save_state", save_or_stop)
    with pytest.raises(StoppedError):
        run_fit(config, tmp_path / "run")
    assert len(losses(tmp_path / "run")) == 3
    resumed = run_fit(config, tmp_path / "run", resume=True)
    assert outcome(resumed) == outcome(whole[1])
    assert losses(tmp_path / "run") == losses(whole[0])


@pytest.mark.parametrize("sampler", ["tpe", "cmaes", "gp", "random"])
def test_study_is_the_same_after_a_kill_within_a_trial(planted_problem, tmp_path, sampler):
    free = {"kappa": {}, "third_gain": {}, "tile_size": {"low": 6, "high": 12}}
    space = make_space(FilterSpec(kind="guertin2014", params=FIXED, free=free))

    def run(path, stop_at=None):
        path.mkdir(exist_ok=True)
        counter = iter(range(1000))
        mean = type(planted_problem).mean

        def stopping(self, values, count=1):
            if next(counter) == stop_at:
                raise StoppedError
            return mean(self, values, count)

        job = BlackBoxJob(
            method=BlackBoxMethod(kind="blackbox", sampler=sampler, trials=12), index=0,
            name=sampler, space=space, fixed={}, first=(space.start(),), seed=4,
        )  # fmt: skip
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(type(planted_problem), "mean", stopping)
            return fit_blackbox(planted_problem, job, RunFolder(path))

    whole = run(tmp_path / "whole")
    for trial in (0, 4, 3):
        with pytest.raises(StoppedError):
            run(tmp_path / "parts", trial)
    resumed = run(tmp_path / "parts")
    assert resumed.params == whole.params
    assert resumed.objective == whole.objective
    assert losses(tmp_path / "parts") == losses(tmp_path / "whole")


def test_torn_lines_of_a_killed_writer(config, tmp_path, whole):
    """A log and a journal whose last lines were not finished, and a lock that nobody holds."""
    with pytest.raises(StoppedError):
        run_fit(config, tmp_path / "run", progress=stop_after("tpe", 2))
    for name in ("log.jsonl", "study-1.log"):
        with (tmp_path / "run" / name).open("a") as file:
            file.write('{"op_code": 4, "wor')
    (tmp_path / "run" / "study-1.log.lock").symlink_to("gone")
    (tmp_path / "run" / ".checkpoint-0.pt.part").write_bytes(b"half")
    began = time.monotonic()
    resumed = run_fit(config, tmp_path / "run", resume=True)
    assert time.monotonic() - began < 25  # Optuna would wait 30 s for the lock
    assert outcome(resumed) == outcome(whole[1])


def test_finished_run_is_not_done_again(config, tmp_path, monkeypatch):
    first = run_fit(config, tmp_path / "run")
    monkeypatch.setattr(tuning.fit.run, "prepare", None)
    assert run_fit(config, tmp_path / "run", resume=True) == first


def test_resume_without_a_run_starts_one(config, tmp_path):
    assert run_fit(config, tmp_path / "new", resume=True).filter == "guertin2014"


def test_two_processes_do_not_share_a_folder(config, tmp_path):
    with open_run(tmp_path / "run", config):
        with pytest.raises(OutputError, match=r"another process works in .*run"):
            run_fit(config, tmp_path / "run", resume=True)
        with pytest.raises(OutputError, match=r"another process works in .*run"):
            run_fit(config, tmp_path / "run", overwrite=True)


def test_killed_before_the_first_line(config, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.lock").write_text("")
    (tmp_path / "run" / ".config.yaml.1.part").write_text("fil")
    with open_run(tmp_path / "run", config, resume=True) as folder:
        assert (folder.path / "config.yaml").is_file()


def test_checkpoints_are_whole_or_not_there(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path)
    folder.save_state("a.pt", {"x": torch.arange(3)})
    monkeypatch.setattr(type(tmp_path), "replace", _full_disk)
    with pytest.raises(OutputError, match=r"cannot write .*a\.pt: No space left"):
        folder.save_state("a.pt", {"x": torch.arange(9)})
    assert folder.load_state("a.pt")["x"].tolist() == [0, 1, 2]
    assert folder.load_state("b.pt") is None


def _full_disk(*args):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(
    ("before", "after"), [("", ""), ("a\nb\n", "a\nb\n"), ("a\nb", "a\n"), ("a", "")]
)
def test_torn_line(tmp_path, before, after):
    (tmp_path / "log").write_text(before)
    trim_torn_line(tmp_path / "log")
    assert (tmp_path / "log").read_text() == after


@pytest.mark.parametrize("lost", ["report.html", "preset.yaml"])
def test_a_finished_run_gets_what_it_lacks_and_nothing_else(whole, tmp_path, monkeypatch, lost):
    folder = tmp_path / "run"
    shutil.copytree(whole[0], folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    (folder / lost).unlink()
    monkeypatch.setattr("tuning.fit.run._evaluate", None)
    monkeypatch.setattr("tuning.fit.run.run_methods", None)
    config = load_tune_config(folder / "config.yaml")
    assert outcome(run_fit(config, folder, resume=True)) == outcome(whole[1])
    assert (folder / lost).stat().st_size == pytest.approx(len(before[lost]), rel=0.2)
    for name in ("result.json", "config.yaml"):
        assert (folder / name).read_bytes() == before[name]
