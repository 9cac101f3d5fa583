"""Compiling: where kernels are kept, and what happens where there is no compiler."""

import os
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import pytest
import torch

from torchblur.filters import get_filter
from torchblur.ops import compiling
from torchblur.testing.frames import moving_square


def run(code: str, **environment: str) -> str:
    """Run Python in a process of its own and return what it prints."""
    kept = {k: v for k, v in os.environ.items() if k not in ("TORCHINDUCTOR_CACHE_DIR", "CXX")}
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env=kept | environment,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def fresh(monkeypatch):
    """A process that has not looked for a compiler yet."""
    monkeypatch.setattr(compiling, "_state", {"works": True, "looked": False})


class TestWhereKernelsAreKept:
    @pytest.mark.parametrize(
        ("given", "expected"),
        [
            ({"TORCHINDUCTOR_CACHE_DIR": "/a", "TORCHBLUR_CACHE": "/b"}, "/a"),
            ({"TORCHBLUR_CACHE": "/b", "XDG_CACHE_HOME": "/c"}, "/b/kernels"),
            ({"XDG_CACHE_HOME": "/c"}, "/c/torchblur/kernels"),
            ({"HOME": "/home/me"}, "/home/me/.cache/torchblur/kernels"),
        ],
    )
    def test_folder(self, monkeypatch, given, expected):
        for name in ("TORCHINDUCTOR_CACHE_DIR", "TORCHBLUR_CACHE", "XDG_CACHE_HOME"):
            monkeypatch.delenv(name, raising=False)
        for name, value in given.items():
            monkeypatch.setenv(name, value)
        assert compiling.kernel_folder() == Path(expected)

    def test_torch_is_told(self, tmp_path):
        code = (
            "import os; from torchblur.ops.compiling import load_compiler; load_compiler();"
            "from torch._inductor.runtime.cache_dir_utils import cache_dir; print(cache_dir())"
        )
        assert run(code, TORCHBLUR_CACHE=str(tmp_path)).strip() == str(tmp_path / "kernels")
        own = run(code, TORCHBLUR_CACHE=str(tmp_path), TORCHINDUCTOR_CACHE_DIR=str(tmp_path / "x"))
        assert own.strip() == str(tmp_path / "x")

    def test_a_folder_that_cannot_be_made_leaves_torchs_own(self, tmp_path):
        (tmp_path / "file").touch()
        code = (
            "import os; from torchblur.ops.compiling import load_compiler; load_compiler();"
            "print(os.environ.get('TORCHINDUCTOR_CACHE_DIR'))"
        )
        assert "torchblur" not in run(code, TORCHBLUR_CACHE=str(tmp_path / "file"))

    @pytest.mark.slow
    def test_a_second_process_compiles_nothing(self, tmp_path):
        code = (
            "from torch._dynamo.utils import counters;"  # torch sets its folder when it is loaded
            "from torchblur.filters import get_filter;"
            "from torchblur.testing.frames import moving_square;"
            "get_filter('line')(engine='compiled')(moving_square()).sum().backward();"
            "found = counters['inductor'];"
            "print(found['fxgraph_cache_miss'], found['fxgraph_cache_hit'])"
        )
        first, second = (run(code, TORCHBLUR_CACHE=str(tmp_path)).split() for _ in range(2))
        assert int(first[0]) > 0
        assert second[0] == "0"
        assert int(second[1]) > 0


class TestWithoutACompiler:
    def test_one_notice_for_all_filters_and_threads(self, fresh, monkeypatch):
        monkeypatch.setattr("torch._inductor.cpp_builder.get_cpp_compiler", _no_compiler)
        frame = moving_square()
        filters = [get_filter(name)(engine="compiled") for name in ("line", "guertin2014")]
        images = []
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            threads = [
                threading.Thread(target=lambda blur=blur: images.append(blur(frame)))
                for blur in filters * 3
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        texts = [str(warning.message) for warning in caught]
        assert len([text for text in texts if "torch.compile does not work here" in text]) == 1
        assert "no C++ compiler" in texts[0]
        assert "--no-compile" in texts[0]
        assert len(images) == len(threads)

    def test_eager_needs_no_compiler_and_says_nothing(self, fresh, monkeypatch):
        monkeypatch.setattr("torch._inductor.cpp_builder.get_cpp_compiler", _no_compiler)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            get_filter("line")()(moving_square())

    def test_after_a_failure_nothing_is_compiled(self, fresh):
        with pytest.warns(UserWarning, match=r"does not work here \(no disk\)"):
            compiling.give_up_compiling(RuntimeError("no disk\nat line 3"))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            compiling.give_up_compiling(RuntimeError("another"))
            assert not compiling.compiler_works()


def test_a_look_at_the_processor_that_fails_says_nothing(monkeypatch):
    """It only saves time: torch looks again where it needs to know, and tells what is wrong."""
    told, looks = [], []

    def fail(name):
        looks.append(name)
        raise RuntimeError("torch has moved it")

    monkeypatch.setattr(threading, "excepthook", told.append)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(compiling.importlib, "import_module", fail)
    compiling._look_at_processor.__wrapped__()
    for thread in threading.enumerate():
        if thread.name == "torchblur-processor":
            thread.join()
    assert len(looks) == 1
    assert not told


@torch._dynamo.config.patch(recompile_limit=2)
def test_functions_of_one_line_are_counted_apart():
    """Torch compiles no code object more often than this limit."""

    def make(number):
        return lambda x: x * number

    before = torch._dynamo.utils.counters["stats"]["unique_graphs"]
    for number in range(4):
        function = compiling.compile_alone(make(number), backend="eager")
        assert torch.equal(function(torch.ones(3)), torch.full((3,), float(number)))
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == before + 4


def _no_compiler():
    raise RuntimeError("no compiler found")
