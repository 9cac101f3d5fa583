import subprocess
import sys

import pytest
import torch

import torchblur
from torchblur.errors import ConfigError, OutputError, TorchblurError
from torchblur.filters import get_filter, list_filters
from torchblur.presets import Preset, create_filter, load_preset, save_preset
from torchblur.testing.frames import moving_square


def test_every_filter_has_a_config_and_every_config_loads(repository):
    folder = repository / "configs" / "filters"
    loaded = {path.stem: load_preset(path).filter for path in folder.rglob("*.yaml")}
    assert set(list_filters()) <= set(loaded)
    for stem, name in loaded.items():
        assert stem.startswith(name)
        create_filter(folder / f"{stem}.yaml")


def test_round_trip(tmp_path):
    path = tmp_path / "p.yaml"
    params = {"kappa": 31.25, "num_samples": 9, "luma": "true", "stochastic_tiles": False}
    save_preset(path, Preset(filter="guertin2014", params=params, evidence={"flip": 0.02}))
    assert load_preset(path).params == params
    frame = moving_square()
    assert torch.equal(
        create_filter(path, gamma=3.0)(frame),
        create_filter("guertin2014", gamma=3.0, **params)(frame),
    )
    with pytest.raises(OutputError, match=r"p\.yaml.*exists"):
        save_preset(path, Preset(filter="line"))
    save_preset(path, Preset(filter="line"), overwrite=True)
    assert load_preset(path).filter == "line"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "filter: guertin\n",
            r"unknown filter `guertin` \(did you mean `guertin2014`.*p\.yaml: fi",
        ),
        ("filter: line\nparams: {shuter: 1}\n", r"`shuter` \(did you mean `shutter`.*p\.yaml: par"),
        ("filter: line\nparams: {shutter: 9}\n", r"`shutter` must lie in \[0, 8\] frame, got 9"),
        ("filtr: line\n", r"unknown key `filtr` \(did you mean `filter`"),
        ("params: {}\n", r"`filter` is required"),
    ],
)
def test_bad_presets(tmp_path, text, message):
    path = tmp_path / "p.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        create_filter(path)


def test_neither_a_filter_nor_a_file():
    with pytest.raises(TorchblurError, match=r"guertin2041.*(did you mean `guertin2014`)"):
        create_filter("guertin2041")
    with pytest.raises(TorchblurError, match=r"missing\.yaml"):
        create_filter("missing.yaml")


def test_in_a_training_loop():
    frame = moving_square()
    target = create_filter("guertin2014", kappa=20.0, noise="none")(frame).detach()
    model = torch.nn.Sequential(create_filter("guertin2014", noise="none"), torch.nn.Identity())
    optimizer = torch.optim.Adam([model[0].kappa], lr=4.0)
    losses = []
    for _ in range(8):
        optimizer.zero_grad()
        loss = (model(frame) - target).square().mean()
        loss.backward()
        optimizer.step()
        model[0].project_()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.5 * losses[0]
    assert model[0].current_config().kappa < 40


def test_the_library_needs_no_application_packages():
    code = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("optuna", "typer", "rich", "matplotlib", "cmaes", "tuning"):
            raise ImportError(name)
sys.meta_path.insert(0, Blocked())
import torch, torchblur
from torchblur.testing.frames import moving_square
assert torchblur.create_filter("guertin2014", num_samples=5)(moving_square()).shape[1] == 3
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_our_own_filter_is_the_default():
    assert create_filter().name == "torchblur"
    assert create_filter(num_samples=8).config.num_samples == 8


def test_public_names_exist():
    for name in torchblur.__all__:
        assert getattr(torchblur, name) is not None


def test_a_module_is_saved_as_it_is_now(tmp_path):
    path = tmp_path / "p.yaml"
    blur = create_filter("guertin2014", kappa=30.0, num_samples=9)
    with torch.no_grad():
        blur.kappa.fill_(31.3)
    save_preset(path, blur, comment="mine")
    assert load_preset(path).params == {"num_samples": 9, "kappa": 31.3}
    assert create_filter(path).current_config() == blur.current_config()
    with torch.no_grad():
        blur.kappa.fill_(0.5)
    with pytest.raises(ConfigError, match=r"`kappa` must lie in"):
        save_preset(path, blur, overwrite=True)


def test_a_filter_that_no_name_leads_to_is_not_saved(tmp_path):
    kind = type("Own", (get_filter("line"),), {})
    kind.name = "nobody"  # too late to be registered
    with pytest.raises(ConfigError, match="unknown filter `nobody`"):
        save_preset(tmp_path / "p.yaml", kind())
