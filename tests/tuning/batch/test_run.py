"""Batch runs: what they write, skip, refuse and survive."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
import torch
from tiny_shots import moving_square, truncate, with_nan_velocity, write_shot
from typer.testing import CliRunner

import tuning.batch.threads
from torchblur.errors import ConfigError, FileFormatError, OutputError
from torchblur.io import read_channels, read_exr, read_frame, read_image, save_yaml, write_frame
from torchblur.presets import Preset, create_filter, save_preset
from tuning.batch.run import BatchConfig, load_batch_config, plan_batch, run_batch
from tuning.cli.app import app


@pytest.fixture
def shot(tmp_path):
    return write_shot(tmp_path / "shot", 4)


def config_for(shot, **changes):
    settings = {
        "filter": "line",
        "params": {"num_samples": 5},
        "root": str(shot[0].parent),
        "inputs": ["sharp.####.exr"],
        "output": "out/",
    }
    return BatchConfig(**(settings | changes))


def batch(config, **options):
    plan = plan_batch(config, **options)
    return plan, run_batch(plan)


def states(config):
    return [state for _, state in plan_batch(config).states]


def stamps(folder):
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


class TestResults:
    def test_are_what_the_module_returns(self, shot):
        _, result = batch(config_for(shot))
        assert [path.name for path in sorted(result.written)] == [p.name for p in shot]
        blur = create_filter("line", num_samples=5)
        with torch.no_grad():
            for path in shot:
                want = blur(read_frame(path)).half().float()
                torch.testing.assert_close(read_image(path.parent / "out" / path.name), want)

    def test_do_not_depend_on_the_number_of_workers(self, shot):
        batch(config_for(shot, output="one/", filter="guertin2014"))
        batch(config_for(shot, output="three/", filter="guertin2014", workers=3, prefetch=0))
        for path in shot:
            one, three = (read_image(path.parent / k / path.name) for k in ("one", "three"))
            assert torch.equal(one, three)

    def test_torch_threads_are_shared_and_given_back(self, shot, monkeypatch):
        seen = []
        original = tuning.batch.threads.blur_frame

        def watched(*args):
            seen.append(torch.get_num_threads())
            return original(*args)

        monkeypatch.setattr(tuning.batch.threads, "blur_frame", watched)
        monkeypatch.setattr(tuning.batch.threads, "count_cores", lambda: 4)
        before = torch.get_num_threads()
        torch.set_num_threads(4)
        try:
            batch(config_for(shot, workers=2))
            assert torch.get_num_threads() == 4
        finally:
            torch.set_num_threads(before)
        assert seen == [2] * 4

    def test_frames_are_read_ahead_but_not_all_at_once(self, shot, monkeypatch):
        reading, most = [0], [0]
        read, blur = tuning.batch.threads.read_samples, tuning.batch.threads.blur_frame

        def counted_read(*args):
            reading[0] += 1
            return read(*args)

        def slow_blur(*args):
            time.sleep(0.1)
            most[0] = max(most[0], reading[0])
            reading[0] -= 1
            return blur(*args)

        monkeypatch.setattr(tuning.batch.threads, "read_samples", counted_read)
        monkeypatch.setattr(tuning.batch.threads, "blur_frame", slow_blur)
        batch(config_for(write_shot(shot[0].parent / "long", 8), workers=1, prefetch=2))
        assert most[0] == 3

    def test_layers_are_written_beside_color(self, shot):
        batch(config_for(shot, filter="guertin2014", params={}, layers=["luma", "velocity"]))
        file = shot[0].parent / "out" / shot[0].name
        frame = read_frame(shot[0])
        velocity = read_channels(file, "velocity.X", "velocity.Y")
        torch.testing.assert_close(velocity, frame.velocity)
        with torch.no_grad():
            luma = create_filter("guertin2014").layers(frame)["luma"]
        torch.testing.assert_close(read_channels(file, "luma"), luma)

    @pytest.mark.parametrize(
        ("layer", "said"), [("lumma", "did you mean `luma`"), ("tile_max", "one per tile")]
    )
    def test_layers_that_cannot_be_written(self, shot, layer, said):
        _, result = batch(config_for(shot, filter="guertin2014", params={}, layers=[layer]))
        assert len(result.failures) == 4
        assert said in result.failures[0].reason

    def test_gbuffer_beside_each_input(self, shot):
        for path in shot:
            write_frame(
                path.with_name(path.name.replace("sharp", "gbuffer")), moving_square(speed=4.0)
            )
        batch(config_for(shot, gbuffer="gbuffer.####.exr"))
        gbuffer = shot[0].with_name("gbuffer.0001.exr")
        with torch.no_grad():
            want = create_filter("line", num_samples=5)(read_frame(shot[0], gbuffer=gbuffer))
        torch.testing.assert_close(
            read_image(shot[0].parent / "out" / shot[0].name), want.half().float()
        )

    def test_overrides_of_the_convention(self, shot):
        batch(config_for(shot, overrides={"velocity_scale": 0.5}))
        with torch.no_grad():
            want = create_filter("line", num_samples=5)(read_frame(shot[0], velocity_scale=0.5))
        torch.testing.assert_close(
            read_image(shot[0].parent / "out" / shot[0].name), want.half().float()
        )

    def test_compiled_engine_on_two_workers(self, shot):
        batch(config_for(shot, engine="compiled", workers=2, output="compiled/"))
        batch(config_for(shot, output="eager/"))
        for path in shot:
            one, two = (read_image(path.parent / k / path.name) for k in ("compiled", "eager"))
            torch.testing.assert_close(one, two, atol=2e-3, rtol=2e-3)


class TestNames:
    def test_folder_of_the_input(self, tmp_path):
        for name in ("a", "b"):
            write_shot(tmp_path / name, 1)
        config = BatchConfig(
            filter="line",
            root=str(tmp_path),
            inputs=["*/sharp.####.exr"],
            output="out/{folder}/{name}.##.exr",
        )
        batch(config)
        found = sorted(str(p.relative_to(tmp_path)) for p in (tmp_path / "out").rglob("*.exr"))
        assert found == ["out/a/sharp.01.exr", "out/b/sharp.01.exr"]

    def test_wildcards_leave_out_references(self, shot):
        plan = plan_batch(config_for(shot, inputs=["*.exr"]))
        assert [job.source.name for job, _ in plan.states] == [path.name for path in shot]

    def test_results_are_no_inputs_of_the_next_run(self, shot):
        config = config_for(shot, inputs=["**/*.exr"])
        batch(config)
        assert states(config) == ["done"] * 4

    def test_frame_2_comes_before_frame_10(self, tmp_path):
        for number in (10, 2, 1):
            write_frame(tmp_path / f"f.{number}.exr", moving_square())
        config = BatchConfig(filter="line", root=str(tmp_path), inputs=["f.*.exr"], output="out")
        names = [job.source.name for job, _ in plan_batch(config).states]
        assert names == ["f.1.exr", "f.2.exr", "f.10.exr"]

    def test_no_match(self, shot):
        with pytest.raises(FileFormatError, match=r"beauty\.\*\.exr.*sharp\.0001\.exr"):
            plan_batch(config_for(shot, inputs=["beauty.*.exr"]))


class TestSecondRun:
    def test_skips_what_is_done(self, shot):
        batch(config_for(shot))
        before = stamps(shot[0].parent / "out")
        _, result = batch(config_for(shot))
        assert result.skipped == 4
        assert stamps(shot[0].parent / "out") == before

    def test_makes_what_is_missing_or_cut_short(self, shot):
        batch(config_for(shot))
        out = shot[0].parent / "out"
        (out / shot[1].name).unlink()
        truncate(out / shot[2].name)
        (out / shot[3].name).write_bytes(b"")
        assert states(config_for(shot)) == ["done", "to do", "to do", "to do"]
        _, result = batch(config_for(shot))
        assert len(result.written) == 3
        assert states(config_for(shot)) == ["done"] * 4

    def test_makes_anew_what_is_older_than_its_input(self, shot):
        batch(config_for(shot))
        os.utime(shot[2], (time.time() + 10, time.time() + 10))
        assert states(config_for(shot)) == ["done", "done", "out of date", "done"]
        assert [path.name for path in batch(config_for(shot))[1].written] == [shot[2].name]

    @pytest.mark.parametrize(
        "changes",
        [
            {"params": {"num_samples": 7}},
            {"layers": ["depth"]},
            {"half": False},
            {"overrides": {"velocity_scale": 2.0}},
            {"filter": "mcguire2012"},
        ],
    )
    def test_refuses_results_of_other_settings(self, shot, changes):
        batch(config_for(shot))
        before = stamps(shot[0].parent / "out")
        plan = plan_batch(config_for(shot, **changes))
        with pytest.raises(OutputError, match=r"4 of 4 outputs.*sharp\.0001\.exr.*--overwrite"):
            run_batch(plan)
        assert stamps(shot[0].parent / "out") == before
        assert len(batch(config_for(shot, **changes), overwrite=True)[1].written) == 4

    def test_settings_that_change_no_pixel_do_not_matter(self, shot):
        batch(config_for(shot))
        assert states(config_for(shot, workers=2, prefetch=5, device="cpu")) == ["done"] * 4

    def test_refuses_files_that_it_did_not_make(self, shot):
        out = shot[0].parent / "out"
        out.mkdir()
        (out / shot[0].name).write_bytes(b"precious text")
        with pytest.raises(OutputError, match="1 of 4 outputs exist"):
            run_batch(plan_batch(config_for(shot)))
        assert stamps(out).keys() == {shot[0].name}

    def test_png_results_are_known_again(self, shot):
        config = config_for(shot, output="out/{stem}.png")
        batch(config)
        assert states(config) == ["done"] * 4

    def test_old_leftovers_are_removed(self, shot):
        out = shot[0].parent / "out"
        out.mkdir()
        old, young, foreign = (
            out / f".{name}.part"
            for name in ("sharp.0001.exr.0a1b2c3d", "sharp.0002.exr.0a1b2c3d", "other.1")
        )
        for path in (old, young, foreign):
            path.write_bytes(b"half")
        for path in (old, foreign):
            os.utime(path, (time.time() - 3600,) * 2)
        batch(config_for(shot))
        assert not old.exists()
        assert young.exists()
        assert foreign.exists()


class TestFailures:
    def test_goes_on_past_bad_frames_and_lists_them(self, shot):
        truncate(shot[0])
        with_nan_velocity(shot[2].with_name("bad.exr")).replace(shot[2])
        _, result = batch(config_for(shot, workers=2))
        assert sorted(path.name for path in result.written) == [shot[1].name, shot[3].name]
        reasons = {f.job.source.name: f.reason for f in result.failures}
        assert "truncated" in reasons[shot[0].name]
        assert "x=5, y=3" in reasons[shot[2].name]

    def test_a_second_run_tries_them_again(self, shot):
        good = shot[0].read_bytes()
        truncate(shot[0])
        batch(config_for(shot))
        shot[0].write_bytes(good)
        _, result = batch(config_for(shot))
        assert [path.name for path in result.written] == [shot[0].name]
        assert result.skipped == 3

    def test_mask_replaces_bad_values(self, shot):
        with_nan_velocity(shot[2].with_name("bad.exr")).replace(shot[2])
        with pytest.warns(UserWarning, match="replaced"):
            _, result = batch(config_for(shot, on_invalid="mask"))
        assert not result.failures


class TestConfig:
    def write(self, tmp_path, **changes):
        data = {"filter": "line", "inputs": ["sharp.*.exr"], "output": "out"} | changes
        save_yaml(tmp_path / "batch.yaml", data)
        return tmp_path / "batch.yaml"

    def test_examples_load(self, repository):
        files = sorted((repository / "configs/batch").glob("*.yaml"))
        assert len(files) >= 2
        for file in files:
            assert load_batch_config(file).inputs

    def test_root_is_relative_to_the_file(self, tmp_path, monkeypatch):
        monkeypatch.chdir("/")
        path = self.write(tmp_path, root="shot")
        assert load_batch_config(path).root == str(tmp_path / "shot")
        assert load_batch_config(path, ["root=tmp"]).root == "/tmp"

    def test_preset_is_relative_to_the_file(self, tmp_path, monkeypatch):
        monkeypatch.chdir("/")
        save_preset(tmp_path / "p.yaml", Preset(filter="line", params={"num_samples": 3}))
        config = load_batch_config(self.write(tmp_path, filter="p.yaml"))
        assert create_filter(config.filter).config.num_samples == 3

    @pytest.mark.parametrize(
        ("changes", "said"),
        [
            ({"output_": "x"}, r"unknown key `output_` \(did you mean `output`\?\).*batch\.yaml"),
            ({"filter": "lime"}, r"unknown filter `lime` \(did you mean `line`\?\).*batch\.yaml"),
            ({"params": {"num_sample": 3}}, r"did you mean `num_samples`.*batch\.yaml"),
            ({"params": {"shutter": 9}}, r"`shutter` must lie in \[0, 8\] frame, got 9"),
            ({"workers": 0}, r"`workers`.*got 0"),
            ({"inputs": []}, r"`inputs`"),
            ({"overrides": {"velocity_scal": 1}}, r"did you mean `velocity_scale`"),
            ({"convention": "blendr"}, r"did you mean `blender`"),
            ({"device": "gpu9"}, r"`device` 'gpu9' cannot be used"),
        ],
    )
    def test_mistakes(self, tmp_path, changes, said):
        with pytest.raises(ConfigError, match=said):
            load_batch_config(self.write(tmp_path, **changes))


class TestCommand:
    @pytest.fixture
    def config(self, shot, tmp_path):
        save_yaml(
            tmp_path / "batch.yaml",
            {"filter": "line", "root": "shot", "inputs": ["sharp.*.exr"], "output": "out"},
        )
        return tmp_path / "batch.yaml"

    def run(self, *args, code=0):
        result = CliRunner().invoke(app, ["batch", *map(str, args)])
        assert result.exit_code == code, f"{result.output}\n{result.exception!r}"
        return result

    def test_dry_run_prints_the_plan_and_does_nothing(self, config, shot):
        output = self.run(config, "--dry-run").stdout
        for path in shot:
            assert f"make   {path} -> {path.parent / 'out' / path.name}" in output
        assert "4 frames: 4 to do" in output
        assert not (shot[0].parent / "out").exists()

    def test_dry_run_tells_what_would_be_refused(self, config):
        self.run(config)
        result = self.run(config, "--dry-run", "--set", "params.shutter=1", code=2)
        assert result.stdout.count("REFUSE") == 4
        assert "--overwrite" in result.stderr

    def test_says_what_was_done(self, config):
        assert "4 of 4 frames written" in self.run(config, "--workers", "2").stdout
        assert "0 of 4 frames written, 4 done before" in self.run(config).stdout

    def test_failed_frames_are_listed_at_the_end(self, config, shot):
        truncate(shot[1])
        result = self.run(config, code=1)
        assert "3 of 4 frames written" in result.stdout
        assert f"error: {shot[1]}: {shot[1]} is truncated" in result.stderr
        assert "1 of 4 frames failed" in result.stderr

    def test_set_reaches_into_mappings(self, config, shot):
        self.run(config, "--set", "params.shutter=1.5", "--set", "params.num_samples=3")
        params = read_exr(shot[0].parent / "out" / shot[0].name).metadata["recipe"]["params"]
        assert params["shutter"] == 1.5
        assert params["num_samples"] == 3


class TestStopping:
    SLOW = """
import signal, sys, time
# A shell starts its background jobs with SIGINT ignored, and so these tests when it runs them.
signal.signal(signal.SIGINT, signal.default_int_handler)
import tuning.batch.threads
original = tuning.batch.threads.blur_frame
def slow(*args):
    time.sleep(0.4)
    return original(*args)
tuning.batch.threads.blur_frame = slow
from tuning.cli import main
main()
"""

    @pytest.fixture
    def started(self, tmp_path):
        """Start a slow run of 12 frames in a process; wait for its first results."""
        write_shot(tmp_path / "shot", 12)
        save_yaml(
            tmp_path / "batch.yaml",
            {
                "filter": "line",
                "root": "shot",
                "inputs": ["sharp.*.exr"],
                "output": "out",
                "workers": 2,
            },
        )
        args = [sys.executable, "-c", self.SLOW, "batch", str(tmp_path / "batch.yaml")]
        process = subprocess.Popen(args, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        out = tmp_path / "shot/out"
        deadline = time.monotonic() + 60
        while len(list(out.glob("sharp.*.exr"))) < 2:
            assert time.monotonic() < deadline, process.communicate()
            assert process.poll() is None, process.communicate()
            time.sleep(0.02)
        yield process, out
        process.kill()
        process.communicate()

    def check_and_finish(self, tmp_path, out):
        """See that all results are whole, and that a second run makes just the others."""
        done = sorted(out.glob("sharp.*.exr"))
        assert 2 <= len(done) < 12
        for path in done:
            assert read_image(path).shape == (1, 3, 48, 64)
        before = stamps(out)
        result = CliRunner().invoke(app, ["batch", str(tmp_path / "batch.yaml")])
        assert result.exit_code == 0, result.output
        assert f"{12 - len(done)} of 12 frames written, {len(done)} done before" in result.stdout
        assert len(list(out.glob("sharp.*.exr"))) == 12
        after = stamps(out)
        assert all(after[path.name] == before[path.name] for path in done)

    def test_ctrl_c_finishes_the_frames_in_flight(self, started, tmp_path):
        process, out = started
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=30)
        assert process.returncode == 130
        assert "Traceback" not in stderr
        assert "frames in flight are finished; Ctrl-C again drops them" in stderr
        assert "the same command goes on" in stderr
        assert not list(out.glob(".*"))
        self.check_and_finish(tmp_path, out)

    def test_kill_leaves_whole_results(self, started, tmp_path):
        process, out = started
        process.kill()
        process.communicate()
        self.check_and_finish(tmp_path, out)

    def test_a_second_ctrl_c_drops_the_frames_in_flight(self, shot, monkeypatch):
        filtering, go_on = threading.Event(), threading.Event()
        original, waited = tuning.batch.threads.blur_frame, []

        def held(*args):
            filtering.set()
            assert go_on.wait(20)
            return original(*args)

        def interrupted(running, **kwargs):
            assert filtering.wait(20)
            waited.append(len(running))
            if len(waited) == 2:
                threading.Timer(0.2, go_on.set).start()
            if len(waited) <= 2:
                raise KeyboardInterrupt
            return real_wait(running, **kwargs)

        real_wait = tuning.batch.threads.wait
        monkeypatch.setattr(tuning.batch.threads, "blur_frame", held)
        monkeypatch.setattr(tuning.batch.threads, "wait", interrupted)
        _, result = batch(config_for(shot))
        assert result.interrupted
        assert result.written == []
        assert result.failures == []
        assert list((shot[0].parent / "out").iterdir()) == []
