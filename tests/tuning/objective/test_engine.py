"""When a filter is compiled by itself: the rule, for fits, files, sequences and commands."""

import dataclasses

import pytest
import torch
from planted_sequences import Recall, moving_sequence
from tiny_shots import HEIGHT, WIDTH, write_shot
from typer.testing import CliRunner

from torchblur.filters import get_filter
from torchblur.io import load_yaml, save_yaml
from torchblur.ops import compiling
from tuning.cli.app import app
from tuning.config.fit import TuneConfig, resolve
from tuning.files.outputs import Job
from tuning.objective.engine import files_engine, fit_engine
from tuning.objective.space import make_space


@pytest.fixture(autouse=True)
def _compiler(monkeypatch):
    monkeypatch.setattr(compiling, "_state", {"works": True, "looked": True})


@pytest.fixture
def limit(monkeypatch):
    """Set the least work that is worth compiling."""
    return lambda work: monkeypatch.setattr(compiling, "_WORTH_COMPILING", {"cpu": work})


def engine_of_fit(problem, planted, *methods, free=None, **others):
    data = planted | {"methods": list(methods), **others}
    if free is not None:
        data["filter"] = data["filter"] | {"free": free}
    config = resolve(TuneConfig(**data))
    problem.blur.engine = config.engine
    return fit_engine(config, problem, make_space(config.filter))


class TestRule:
    def test_limit_counts_pixels_and_taps(self, limit):
        limit(1000)
        blur = get_filter("line")(num_samples=10)
        assert blur.engine == "eager"
        assert blur.engine_for(100) == "eager"
        assert blur.engine_for(101) == "compiled"

    @pytest.mark.parametrize("engine", ["eager", "compiled"])
    def test_what_is_asked_for_is_done(self, engine):
        blur = get_filter("line")(engine=engine)
        assert blur.engine_for(1) == blur.engine_for(1e15) == blur.engine == engine

    def test_without_a_compiler_one_notice_and_only_if_it_is_worth_it(self, limit, monkeypatch):
        monkeypatch.setattr(compiling, "_state", {"works": True, "looked": False})
        monkeypatch.setattr(compiling, "_missing_compiler", lambda: "no C++ compiler")
        limit(1000)
        blur = get_filter("line")(num_samples=10)
        assert blur.engine_for(100) == "eager"
        with pytest.warns(UserWarning, match="no C\\+\\+ compiler") as caught:
            assert [blur.engine_for(1000) for _ in range(3)] == ["eager"] * 3
        assert len(caught) == 1

    def test_a_small_job_stays_eager(self):
        assert get_filter("guertin2014")().engine_for(1280 * 720) == "eager"
        assert get_filter("guertin2014")().engine_for(1280 * 720 * 100) == "compiled"


class TestFit:
    PIXELS = 2 * 48 * 64 * 11  # of both windows, times taps

    @pytest.mark.parametrize(
        ("method", "calls"),
        [
            ({"kind": "blackbox", "trials": 10}, 10),
            ({"kind": "gradient", "steps": 5, "starts": 3}, 60),
            ({"kind": "gradient", "steps": 5, "starts": 3, "batch": 1}, 30),
            ({"kind": "blackbox", "trials": 10, "polish": {"steps": 4, "quantile": 0.5}}, 90),
        ],
    )
    def test_all_evaluations_count(self, planted_problem, planted_folders, limit, method, calls):
        limit(self.PIXELS * calls)
        assert engine_of_fit(planted_problem, planted_folders, method) == "eager"
        limit(self.PIXELS * calls - 1)
        assert engine_of_fit(planted_problem, planted_folders, method) == "compiled"

    def test_methods_add_up(self, planted_problem, planted_folders, limit):
        method = {"kind": "blackbox", "trials": 10}
        limit(self.PIXELS * 19)
        assert engine_of_fit(planted_problem, planted_folders, method) == "eager"
        assert engine_of_fit(planted_problem, planted_folders, method, method) == "compiled"

    def test_each_structure_is_compiled(self, planted_problem, planted_folders, limit):
        method = {"kind": "blackbox", "trials": 10}
        limit(self.PIXELS * 9)
        free = ["kappa", "color_lookup"]
        assert engine_of_fit(planted_problem, planted_folders, method) == "compiled"
        assert engine_of_fit(planted_problem, planted_folders, method, free=free) == "eager"

    def test_the_key_decides(self, planted_problem, planted_folders, limit):
        method = {"kind": "blackbox", "trials": 10}
        limit(1)
        found = engine_of_fit(planted_problem, planted_folders, method, engine="eager")
        assert found == "eager"


class TestFiles:
    def test_all_files_count_and_their_samples(self, tmp_path, limit):
        paths = write_shot(tmp_path, 3)
        jobs = [Job(path, path, None) for path in paths]
        blur = get_filter("line")(num_samples=10)
        limit(HEIGHT * WIDTH * 10 * 3)
        assert files_engine(blur, jobs) == "eager"
        more = [dataclasses.replace(job, samples=(job.source,)) for job in jobs]
        assert files_engine(blur, more) == "compiled"
        limit(HEIGHT * WIDTH * 10 * 3 - 1)
        assert files_engine(blur, jobs) == "compiled"

    def test_files_that_cannot_be_read_are_passed_over(self, tmp_path, limit):
        paths = write_shot(tmp_path, 2)
        paths[0].write_bytes(b"no image")
        jobs = [Job(path, path, None) for path in (tmp_path / "none.exr", *paths)]
        blur = get_filter("line")(num_samples=10)
        limit(HEIGHT * WIDTH * 10 * 2)
        assert files_engine(blur, jobs) == "compiled"
        assert files_engine(blur, jobs[:2]) == "eager"


def test_a_sequence_is_compiled_if_it_is_long_enough(limit):
    seen = []

    class Spy(Recall):
        def advance(self, samples, history, values):
            seen.append(self.engine)
            return super().advance(samples, history, values)

    sequence = moving_sequence(3)
    blur = Spy()
    limit(3 * 48 * 64 * 16)
    eager = blur.sequence(sequence)
    limit(3 * 48 * 64 * 16 - 1)
    compiled = blur.sequence(sequence)
    assert seen == ["eager"] * 3 + ["compiled"] * 3
    assert blur.engine == "eager"
    compiled[-1].sum().backward()
    assert blur.gain.grad is not None
    assert torch.equal(eager[-1], compiled[-1])


class TestNoCompile:
    def test_tune_keeps_it_in_the_run(self, planted_folders, tmp_path, limit):
        limit(1)
        data = planted_folders | {"methods": [{"kind": "blackbox", "trials": 2}]}
        save_yaml(tmp_path / "fit.yaml", data)
        arguments = ["tune", str(tmp_path / "fit.yaml"), "-o", str(tmp_path / "run")]
        result = CliRunner().invoke(app, [*arguments, "--no-compile"])
        assert result.exit_code == 0, result.output
        assert load_yaml(tmp_path / "run" / "config.yaml")["engine"] == "eager"
        assert not compiling.compiler_works()

    @pytest.mark.parametrize("command", ["filter", "batch", "render", "ablate", "study"])
    def test_every_command_that_compiles_has_it(self, command, tmp_path):
        words = {"filter": ["line", "none.exr", "-o", "x.exr"], "render": ["none", "-o", "x"]}
        given = words.get(command, [str(tmp_path / "none.yaml")])
        assert CliRunner().invoke(app, [command, *given, "--no-compile"]).exit_code == 2
        assert not compiling.compiler_works()
