import contextlib
import pickle
import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

import torchblur
from torchblur.errors import ConfigError, FileFormatError
from torchblur.filters import FilterConfig, get_filter, list_filters, load_plugin, register_filter
from torchblur.filters import registry as registry_module
from torchblur.testing.frames import moving_square

PLUGIN = """
from torchblur import BlurFilter, FilterConfig

class Still(BlurFilter):
    \"\"\"The frame as it is.\"\"\"
    name = "still"
    config_class = FilterConfig
    def compute(self, frame, values):
        return {"color": frame.color}
"""


@pytest.fixture(autouse=True)
def registry(monkeypatch):
    """The filters of torchblur alone; what a test registers is forgotten after it."""
    own = dict(registry_module._REGISTRY)
    monkeypatch.setattr(registry_module, "_REGISTRY", own)
    return own


def make(name="mine", base=torchblur.BlurFilter):
    class Mine(base):
        config_class = FilterConfig

    Mine.name = name  # too late to be registered by itself
    return Mine


class TestRegister:
    def test_a_class_with_a_name_registers_itself(self):
        class Mine(torchblur.BlurFilter):
            name = "mine"
            config_class = FilterConfig

        assert get_filter("mine") is list_filters()["mine"] is Mine
        assert register_filter(Mine) is Mine

    def test_a_taken_name_is_refused(self, registry):
        pattern = (
            r"`name` must be its own, got `line`, which is torchblur\.filters\.\S*LineBlur "
            r"\(\S*Other\); give the class another `name`"
        )
        with pytest.raises(ConfigError, match=pattern):

            class Other(torchblur.BlurFilter):
                name = "line"
                config_class = FilterConfig

        assert get_filter("line").__name__ == "LineBlur"
        # A subclass without a name of its own has its parent's.
        with pytest.raises(ConfigError, match="got `line`, which is"):
            register_filter(make("line", get_filter("line")))

    def test_the_same_class_made_again_replaces_the_first(self):
        first, second = make(), make()
        register_filter(first)
        assert register_filter(second) is get_filter("mine") is second

    @pytest.mark.parametrize("name", ["", None, 3])
    def test_a_name_is_needed(self, name):
        with pytest.raises(ConfigError, match=r"`name` must be a text, got .*Mine"):
            register_filter(make(name))


class TestEntryPoints:
    @pytest.fixture
    def installed(self, monkeypatch, tmp_path):
        """Return a function that lets a package `pack` of some source be installed."""

        def install(source, value="blur_pack:Still", broken=()):
            (tmp_path / "blur_pack.py").write_text(source)
            info = tmp_path / "blur_pack-1.5.dist-info"
            info.mkdir()
            (info / "METADATA").write_text("Metadata-Version: 2.1\nName: blur-pack\nVersion: 1.5\n")
            lines = ["[torchblur.filters]", *broken, f"still = {value}"]
            (info / "entry_points.txt").write_text("\n".join(lines))
            monkeypatch.syspath_prepend(tmp_path)
            monkeypatch.setattr(registry_module, "_searched", False)
            monkeypatch.delitem(sys.modules, "blur_pack", raising=False)

        yield install
        sys.modules.pop("blur_pack", None)

    @pytest.mark.parametrize("value", ["blur_pack:Still", "blur_pack"])
    def test_filters_of_installed_packages_are_found(self, installed, value):
        installed(PLUGIN, value)
        assert "still" in list_filters()
        assert torchblur.create_filter("still")(moving_square()).shape[1] == 3

    def test_they_are_found_by_name_and_not_before(self, installed):
        installed(PLUGIN)
        get_filter("line")
        assert "blur_pack" not in sys.modules
        assert get_filter("still").__name__ == "Still"

    @pytest.mark.parametrize(
        ("source", "value", "cause"),
        [
            (PLUGIN + "raise RuntimeError('no device')", "blur_pack:Still", "RuntimeError: no dev"),
            (PLUGIN.replace('"still"', '"line"'), "blur_pack:Still", "got `line`, which is"),
            (PLUGIN, "blur_pack:Gone", "AttributeError"),
            ("number = 3", "blur_pack:number", "a filter's class or a module is needed, got 3"),
        ],
    )
    def test_a_broken_one_is_left_out_with_one_warning(self, installed, source, value, cause):
        installed(source, value)
        before = set(registry_module._REGISTRY)
        with pytest.warns(
            UserWarning, match=rf"`still` of blur-pack 1\.5 cannot be.*{cause}"
        ) as all_:
            assert set(list_filters()) == before
        assert [str(w.message) for w in all_] == [str(all_[0].message)]
        assert all_[0].filename == __file__
        assert set(list_filters()) == before  # and no second warning

    def test_the_others_are_loaded(self, installed):
        installed(PLUGIN, broken=("aaa = nowhere:Blur",))
        with pytest.warns(UserWarning, match="No module named 'nowhere'"):
            assert "still" in list_filters()

    def test_a_package_that_asks_for_filters_while_it_is_imported(self, installed):
        installed(PLUGIN + "import torchblur\nnames = list(torchblur.list_filters())")
        assert "still" in list_filters()

    def test_an_entry_point_without_a_package(self, monkeypatch):
        entry = EntryPoint("odd", "nowhere:Blur", registry_module.ENTRY_POINTS)
        monkeypatch.setattr(registry_module, "entry_points", lambda group: [entry])
        monkeypatch.setattr(registry_module, "_searched", False)
        with pytest.warns(UserWarning, match="`odd` of a package cannot be loaded"):
            list_filters()

    def test_importing_torchblur_loads_none(self, tmp_path):
        (tmp_path / "blur_pack.py").write_text("raise RuntimeError")
        info = tmp_path / "blur_pack-1.5.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: blur-pack\nVersion: 1.5\n")
        (info / "entry_points.txt").write_text("[torchblur.filters]\nstill = blur_pack")
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import torchblur"
        done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True)
        assert done.returncode == 0, done.stderr


class TestPlugin:
    @pytest.fixture
    def plugin(self, tmp_path):
        path = tmp_path / "my blur.py"
        path.write_text(PLUGIN)
        yield path
        for name in [name for name in sys.modules if name.startswith("torchblur_plugin_my blur")]:
            del sys.modules[name]

    def test_its_filters_are_registered(self, plugin):
        made = load_plugin(plugin)
        assert made == {"still": get_filter("still")}
        frame = moving_square()
        blur = pickle.loads(pickle.dumps(torchblur.create_filter("still")))
        assert blur(frame).equal(frame.color)

    def test_loaded_again_it_replaces_them(self, plugin):
        first = load_plugin(plugin)["still"]
        second = load_plugin(str(plugin))["still"]
        assert second is get_filter("still") is not first

    def test_two_files_of_one_name_are_two(self, plugin, tmp_path):
        load_plugin(plugin)
        (tmp_path / "b").mkdir()
        other = tmp_path / "b" / plugin.name
        other.write_text(PLUGIN)
        with pytest.raises(ConfigError, match="got `still`, which is torchblur_plugin_my blur"):
            load_plugin(other)
        other.write_text(PLUGIN.replace("still", "other"))
        assert list(load_plugin(other)) == ["other"]

    def test_no_such_file(self, tmp_path):
        with pytest.raises(FileFormatError, match=r"the plugin .*gone\.py does not exist"):
            load_plugin(tmp_path / "gone.py")
        with pytest.raises(FileFormatError, match="is a folder; a Python file is needed"):
            load_plugin(tmp_path)

    @pytest.mark.parametrize(
        ("more", "cause", "message"),
        [
            (
                "import nowhere",
                ImportError,
                r"ModuleNotFoundError: No module named 'nowhere' \(line",
            ),
            ("def f(:", SyntaxError, r"SyntaxError: .*line 10"),
            ("raise SystemExit(2)", SystemExit, r"SystemExit: 2 \(line 10\)"),
        ],
    )
    def test_one_that_fails_registers_nothing(self, plugin, more, cause, message):
        plugin.write_text(PLUGIN + more)
        with pytest.raises(
            ConfigError, match=rf"the plugin .*my blur\.py cannot be.*{message}"
        ) as e:
            load_plugin(plugin)
        assert isinstance(e.value.__cause__, cause)
        assert "still" not in list_filters()
        assert not [name for name in sys.modules if name.startswith("torchblur_plugin_my blur")]

    def test_one_that_fails_leaves_what_it_was_before(self, plugin):
        before = load_plugin(plugin)["still"]
        plugin.write_text(PLUGIN + "1 / 0")
        with contextlib.suppress(ConfigError):
            load_plugin(plugin)
        assert get_filter("still") is before
        assert sys.modules[before.__module__].Still is before

    def test_one_without_filters(self, plugin):
        plugin.write_text("x = 1")
        with pytest.raises(ConfigError, match=r"my blur\.py makes no filter; .*with a `name`"):
            load_plugin(plugin)
