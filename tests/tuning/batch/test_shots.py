"""Files through a filter with a memory: order, gaps, cuts, resumed and killed runs."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from planted_sequences import Recall, moving_sequence
from tiny_shots import truncate, with_nan_velocity
from typer.testing import CliRunner

import tuning.batch.threads
from torchblur.errors import ConfigError, FileFormatError, OutputError
from torchblur.frame import FrameSequence
from torchblur.io import read_frame, read_image, save_yaml, write_frame, write_image
from torchblur.metrics import evaluate, temporal_errors
from tuning.batch.run import BatchConfig, plan_batch, run_batch
from tuning.batch.single import filter_files, load_settings, plan_files
from tuning.cli.app import app
from tuning.files.frame_numbers import shots_of
from tuning.files.outputs import Job

pytestmark = pytest.mark.usefixtures("recall")


def write_stream(folder, numbers=range(1, 7), name="stream", seed=0):
    """Write NAME.####.exr of an own noise each."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers = list(numbers)
    paths = []
    for number, frame in zip(numbers, moving_sequence(len(numbers), seed), strict=True):
        paths.append(folder / f"{name}.{number:04d}.exr")
        write_frame(paths[-1], frame, half=False)
    return paths


def expected(paths, cuts=()):
    """Return what the filter's own loop over a sequence gives."""
    with torch.no_grad():
        return Recall().sequence(FrameSequence(tuple(read_frame(p) for p in paths), cuts))


def config_for(folder, **changes):
    settings = {
        "filter": "recall", "root": str(folder), "inputs": ["stream.####.exr"], "output": "out/",
        "half": False,
    }  # fmt: skip
    return BatchConfig(**(settings | changes))


def batch(config, **options):
    plan = plan_batch(config, **options)
    return plan, run_batch(plan)


def states(config):
    return [state for _, state in plan_batch(config).states]


def results(folder, paths):
    return [read_image(folder / path.name) for path in paths]


def assert_equal(got, want):
    for image, other in zip(got, want, strict=True):
        assert torch.equal(image, other)


@pytest.fixture
def stream(tmp_path):
    return write_stream(tmp_path / "shot")


class TestShotsOf:
    def jobs(self, *names):
        return [Job(Path(name), Path("out")) for name in names]

    def names(self, shots):
        return [[str(job.source) for job in shot] for shot in shots]

    def test_numbers_gaps_and_folders(self):
        jobs = self.jobs("a/s.10.exr", "a/s.2.exr", "a/s.1.exr", "b/s.3.exr", "a/s.11.exr")
        assert self.names(shots_of(jobs)) == [
            ["a/s.1.exr", "a/s.2.exr"], ["a/s.10.exr", "a/s.11.exr"], ["b/s.3.exr"],
        ]  # fmt: skip

    def test_cuts(self):
        jobs = self.jobs("s1.exr", "s2.exr", "s3.exr")
        assert self.names(shots_of(jobs, (3,))) == [["s1.exr", "s2.exr"], ["s3.exr"]]
        assert len(shots_of(jobs, (1,))) == 1

    def test_names_are_kept_apart(self):
        jobs = self.jobs("left.1.exr", "right.2.exr", "plain.exr", "other.exr")
        assert len(shots_of(jobs)) == 4


class TestFilterCommand:
    def run(self, *args, code=0):
        result = CliRunner().invoke(app, ["filter", *map(str, args)])
        assert result.exit_code == code, f"{result.output}\n{result.exception!r}"
        return result

    def test_frames_in_order_with_their_past(self, stream, tmp_path):
        shuffled = [stream[3], stream[0], stream[5], *stream[1:3], stream[4]]
        self.run("recall", *shuffled, "-o", tmp_path / "out", "--set", "half=false")
        assert_equal(results(tmp_path / "out", stream), expected(stream))

    def test_a_gap_resets(self, tmp_path):
        paths = write_stream(tmp_path / "shot", [1, 2, 3, 7, 8])
        self.run("recall", *paths, "-o", tmp_path / "out", "--set", "half=false")
        assert_equal(results(tmp_path / "out", paths), expected(paths, (3,)))

    def test_cuts_reset(self, stream, tmp_path):
        sets = ["--set", "half=false", "--set", "cuts=[3, 5]"]
        self.run("recall", tmp_path / "shot/stream.####.exr", "-o", tmp_path / "out", *sets)
        assert_equal(results(tmp_path / "out", stream), expected(stream, (2, 4)))

    def test_a_change_of_size_resets(self, stream, tmp_path):
        for path in stream[3:]:
            small = read_frame(path).crop(0, 0, 20, 30)
            write_frame(path, small, half=False, overwrite=True)
        self.run("recall", *stream, "-o", tmp_path / "out", "--set", "half=false")
        want = [*expected(stream[:3]), *expected(stream[3:])]
        assert_equal(results(tmp_path / "out", stream), want)

    def test_several_samples_per_pixel(self, tmp_path):
        first = write_stream(tmp_path / "shot", name="stream01")
        write_stream(tmp_path / "shot", name="stream02", seed=4)
        sets = ["--set", "half=false", "--set", "samples=[stream02.####.exr]"]
        self.run("recall", *first, "-o", tmp_path / "out", *sets)
        frames = [
            [read_frame(p), read_frame(p.with_name(p.name.replace("stream01", "stream02")))]
            for p in first
        ]
        history, want = None, []
        for step in frames:
            color, history = Recall()(step, history)
            want.append(color.detach())
        assert_equal(results(tmp_path / "out", first), want)
        result = self.run("line", *first, "-o", tmp_path / "l", *sets, code=2)
        assert "`samples` are for filters that take several samples per pixel" in result.stderr

    def test_data_without_times(self, stream, tmp_path):
        frame = dataclasses.replace(read_frame(stream[0]), time=None)
        write_frame(stream[0], frame, overwrite=True)
        result = self.run("recall", *stream, "-o", tmp_path / "out", code=2)
        assert "error: the layer `time` is needed and is missing" in result.stderr
        assert "stream.0001.exr" in result.stderr
        assert result.stderr.count("error:") == 1

    def test_figures_beside_references(self, stream, tmp_path):
        for path, color in zip(stream, expected(stream), strict=True):
            reference = path.with_name(path.name.replace("stream", "reference"))
            write_image(reference, (color * 0.9), half=False)
        references = [p.with_name(p.name.replace("stream", "reference")) for p in stream]
        jobs = plan_files(
            [str(p) for p in stream], None, reference=str(tmp_path / "shot/reference.####.exr")
        )
        scores = filter_files(load_settings("recall", []), jobs)
        assert list(scores.by_name) == ["input", "recall"]
        truth = [read_image(path) for path in references]
        images = expected(stream)
        flips = [float(evaluate(i, t)["flip"]) for i, t in zip(images, truth, strict=True)]
        assert scores.by_name["recall"]["flip"] == pytest.approx(sum(flips) / 6, rel=1e-5)
        changes = temporal_errors(images, truth)[1:].mean()
        assert scores.by_name["recall"]["temporal"] == pytest.approx(float(changes), rel=1e-5)
        output = self.run(
            "recall", *stream, "--reference", tmp_path / "shot/reference.####.exr"
        ).stdout
        assert "in time" in output
        assert "median" in output


class TestBatch:
    @pytest.mark.parametrize("settings", [{}, {"workers": 3}, {"prefetch": 0}, {"prefetch": 9}])
    def test_is_what_the_loop_gives(self, stream, settings):
        other = write_stream(stream[0].parent / "b", [4, 5], seed=2)
        plan, result = batch(config_for(stream[0].parent, inputs=["**/stream.####.exr"],
                                        output="out/{folder}/", **settings))  # fmt: skip
        assert len(result.written) == len(plan.states) == 8
        assert not result.failures
        assert_equal(results(stream[0].parent / "out", stream), expected(stream))
        assert_equal(results(stream[0].parent / "out/b", other), expected(other))

    def test_single_files_command_agrees(self, stream, tmp_path):
        batch(config_for(stream[0].parent))
        CliRunner().invoke(
            app, ["filter", "recall", *map(str, stream), "-o", str(tmp_path / "one"), "--set",
                  "half=false"],
        )  # fmt: skip
        out = stream[0].parent / "out"
        assert_equal(results(out, stream), results(tmp_path / "one", stream))

    def test_cuts_and_gaps(self, tmp_path):
        paths = write_stream(tmp_path, [1, 2, 3, 4, 8, 9])
        batch(config_for(tmp_path, cuts=[3], workers=2))
        assert_equal(results(tmp_path / "out", paths), expected(paths, (2, 4)))

    def test_layers(self, stream):
        batch(config_for(stream[0].parent, layers=["age", "velocity"]))
        file = read_frame(stream[0].parent / "out" / stream[2].name)
        assert torch.equal(file.velocity, read_frame(stream[2]).velocity)


class TestSecondRun:
    @pytest.mark.parametrize("lost", [[0], [3], [5], [1, 4], [2, 3, 4, 5]])
    def test_what_is_missing_is_made_with_its_past(self, stream, lost):
        config = config_for(stream[0].parent)
        batch(config)
        out = stream[0].parent / "out"
        want = results(out, stream)
        for index in lost:
            (out / stream[index].name).unlink()
        stamps = {p.name: p.stat().st_mtime_ns for p in out.iterdir()}
        _, result = batch(config)
        assert sorted(p.name for p in result.written) == [stream[i].name for i in lost]
        assert result.skipped == 6 - len(lost)
        assert_equal(results(out, stream), want)
        for name, stamp in stamps.items():
            assert (out / name).stat().st_mtime_ns == stamp
        assert states(config) == ["done"] * 6

    def test_only_what_is_needed_is_filtered(self, stream, monkeypatch):
        config = config_for(stream[0].parent)
        batch(config)
        (stream[0].parent / "out" / stream[2].name).unlink()
        seen, original = [], tuning.batch.threads.blur_step

        def watched(blur, samples, *args):
            seen.append(Path(samples[0].source).name)
            return original(blur, samples, *args)

        monkeypatch.setattr(tuning.batch.threads, "blur_step", watched)
        batch(config)
        assert seen == [path.name for path in stream[:3]]

    def test_a_changed_input_makes_what_follows_out_of_date(self, stream):
        config = config_for(stream[0].parent)
        batch(config)
        later = time.time() + 10
        os.utime(stream[2], (later, later))
        assert states(config) == ["done"] * 2 + ["out of date"] * 4

    def test_an_earlier_beginning_makes_all_of_the_shot_out_of_date(self, tmp_path):
        paths = write_stream(tmp_path, [1, 2, 4, 5])
        config = config_for(tmp_path)
        batch(config)
        assert states(config) == ["done"] * 4
        long_ago = time.time() - 1000
        write_frame(tmp_path / "stream.0003.exr", read_frame(paths[0]), half=False)
        os.utime(tmp_path / "stream.0003.exr", (long_ago, long_ago))
        assert states(config) == ["done", "done", "to do", "out of date", "out of date"]
        batch(config)
        whole = sorted(tmp_path.glob("stream.*.exr"))
        assert_equal(results(tmp_path / "out", whole), expected(whole))
        assert states(config_for(tmp_path, cuts=[4])) == ["done"] * 3 + ["out of date"] * 2

    def test_other_settings_are_refused(self, stream):
        batch(config_for(stream[0].parent))
        with pytest.raises(OutputError, match="6 of 6 outputs"):
            batch(config_for(stream[0].parent, params={"gain": 0.3}))
        with pytest.raises(OutputError, match="6 of 6 outputs"):
            batch(config_for(stream[0].parent, samples=["stream.####.exr"]))


class TestFailures:
    def test_the_rest_of_the_shot_is_not_made(self, stream):
        other = write_stream(stream[0].parent, [10, 11], seed=3)
        good = stream[2].read_bytes()
        truncate(stream[2])
        config = config_for(stream[0].parent, workers=2)
        _, result = batch(config)
        assert sorted(p.name for p in result.written) == [p.name for p in [*stream[:2], *other]]
        reasons = {f.job.source.name: f.reason for f in result.failures}
        assert list(reasons) == [path.name for path in stream[2:]]
        assert "truncated" in reasons["stream.0003.exr"]
        want = "not made, as stream.0003.exr before it in its shot failed"
        assert {reasons[path.name] for path in stream[3:]} == {want}
        stream[2].write_bytes(good)
        _, result = batch(config)
        assert not result.failures
        assert_equal(results(stream[0].parent / "out", stream), expected(stream))

    def test_a_frame_that_went_bad_after_its_result(self, stream):
        config = config_for(stream[0].parent)
        batch(config)
        (stream[0].parent / "out" / stream[4].name).unlink()
        stamp = stream[1].stat()
        with_nan_velocity(stream[1].with_name("bad.exr")).replace(stream[1])
        os.utime(stream[1], ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
        _, result = batch(config)
        (failure,) = result.failures
        assert failure.job.source == stream[4]
        assert "stream.0002.exr before it in its shot failed: " in failure.reason
        assert "x=5, y=3" in failure.reason

    def test_samples_of_another_size(self, stream):
        for path in stream:
            frame = read_frame(path).crop(0, 0, 8, 8)
            write_frame(path.with_name(path.name.replace("stream", "more")), frame)
        _, result = batch(config_for(stream[0].parent, samples=["more.####.exr"]))
        assert "must have one size" in result.failures[0].reason

    def test_samples_need_a_filter_that_takes_them(self, stream):
        with pytest.raises(ConfigError, match="`samples` are for filters"):
            plan_batch(config_for(stream[0].parent, filter="line", samples=["more.####.exr"]))

    def test_missing_samples(self, stream):
        config = config_for(stream[0].parent, samples=["none.####.exr"])
        assert "none.0001.exr does not exist" in batch(config)[1].failures[0].reason
        with pytest.raises(FileFormatError):
            plan_batch(config_for(stream[0].parent, inputs=["none.####.exr"]))


SLOW = """
import signal, sys, time
# A shell starts its background jobs with SIGINT ignored, and so these tests when it runs them.
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.path.insert(0, TESTS)
import torchblur.filters.parts.registry
from planted_sequences import Recall
torchblur.filters.parts.registry._REGISTRY["recall"] = Recall
import tuning.batch.threads
original = tuning.batch.threads.blur_step
def slow(*args):
    time.sleep(0.3)
    return original(*args)
tuning.batch.threads.blur_step = slow
from tuning.cli import main
main()
"""


class TestStopping:
    @pytest.fixture
    def started(self, tmp_path, repository):
        """Start a slow run of 12 frames in a process; wait for its first results."""
        write_stream(tmp_path, range(1, 13))
        data = {
            "filter": "recall", "inputs": ["stream.####.exr"], "output": "out", "half": False,
        }  # fmt: skip
        save_yaml(tmp_path / "batch.yaml", data)
        script = SLOW.replace("TESTS", repr(str(repository / "tests")))
        args = [sys.executable, "-c", script, "batch", str(tmp_path / "batch.yaml")]
        process = subprocess.Popen(args, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        deadline = time.monotonic() + 90
        while len(list((tmp_path / "out").glob("stream.*.exr"))) < 3:
            assert time.monotonic() < deadline, process.communicate()
            assert process.poll() is None, process.communicate()
            time.sleep(0.02)
        yield process
        process.kill()
        process.communicate()

    @pytest.mark.parametrize("how", ["kill", "ctrl-c"])
    def test_gone_on_with_it_is_the_whole_run(self, started, tmp_path, how):
        if how == "kill":
            started.kill()
            started.communicate()
        else:
            started.send_signal(signal.SIGINT)
            _, stderr = started.communicate(timeout=60)
            assert started.returncode == 130
            assert "Traceback" not in stderr
            assert "the same command goes on" in stderr
            assert not list((tmp_path / "out").glob(".*"))
        done = sorted((tmp_path / "out").glob("stream.*.exr"))
        assert 3 <= len(done) < 12
        result = CliRunner().invoke(app, ["batch", str(tmp_path / "batch.yaml")])
        assert result.exit_code == 0, result.output
        assert f"{12 - len(done)} of 12 frames written, {len(done)} done before" in result.stdout
        paths = sorted(tmp_path.glob("stream.*.exr"))
        assert_equal(results(tmp_path / "out", paths), expected(paths))
