"""Families of scenes: drawn alike everywhere, within their ranges, and all of them render."""

import copy
import statistics
import subprocess
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchblur.errors import ConfigError
from torchblur.frame import Shutter
from torchblur.io import save_yaml
from torchblur.metrics import border_band
from torchblur.params import build
from torchblur.render import (
    SceneFamily,
    draw_scene,
    load_family,
    load_scene,
    render_frame,
    render_reference,
)
from torchblur.render.family_config import BodyKind, CameraMotion, Motion
from torchblur.render.family_dice import Dice
from torchblur.render.mesh_body import Mesh
from torchblur.render.motion import fold
from torchblur.render.scene import Group

SIMPLE = {
    "camera": {"fov": [60, 60], "height": [1, 1], "tilt": [0, 0]},
    "backdrop": {"chance": 0},
    "floor": {"chance": 0},
    "groups": [{"name": "a", "count": [2, 2], "kinds": {"sphere": 1}, "size": [0.1, 0.2]}],
}
IN_THE_MIDDLE = {"count": [1, 1], "across": [0, 0], "up": [0, 0]}
WIDTH = 2 / 3**0.5  # of the image at depth 1, with that field of view


def family_of(group=None, **others) -> SceneFamily:
    data = copy.deepcopy(SIMPLE)
    data["groups"][0] |= group or {}
    return build(SceneFamily, data | others)


@pytest.fixture(scope="module")
def everyday(repository):
    return load_family(repository / "configs/families/everyday.yaml")


def same_bytes_elsewhere(family, seed):
    """Draw in a process with another hash seed."""
    code = (
        "import sys; from torchblur.params import build;"
        "from torchblur.render import SceneFamily, draw_scene;"
        "import json; family = build(SceneFamily, json.loads(sys.argv[1]));"
        f"print(draw_scene(family, {seed}).fingerprint())"
    )
    command = [sys.executable, "-c", code, family.model_dump_json()]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


class TestDrawing:
    def test_same_seed_same_scene(self, everyday):
        scene = draw_scene(everyday, 5)
        assert draw_scene(everyday, 5) == scene
        assert same_bytes_elsewhere(everyday, 5) == scene.fingerprint()
        assert len({draw_scene(everyday, seed).fingerprint() for seed in range(40)}) == 40

    def test_numbers_are_those_of_any_machine(self):
        """A change here changes every scene of every family."""
        dice = Dice(7).of("group").of(0)
        assert dice.chance("x") == 0.49501770458165006
        assert dice.log_between("y", (1.0, 100.0)) == pytest.approx(15.489753593163043)
        assert dice.pick("k", {"b": 1, "a": 1}) == "a"

    def test_another_body_changes_no_other(self):
        two, three = (draw_scene(family_of({"count": [n, n]}), 3) for n in (2, 3))
        assert three.bodies[:2] == two.bodies
        assert len({body.position for body in three.bodies}) == 3
        more = [SIMPLE["groups"][0] | {"name": "b"}, SIMPLE["groups"][0]]
        both = draw_scene(family_of(groups=more), 3)
        assert both.bodies[2:] == two.bodies
        assert both.bodies[:2] != two.bodies

    def test_a_scene_survives_its_file(self, everyday, tmp_path):
        scene = draw_scene(everyday, 11)
        save_yaml(tmp_path / "a.yaml", scene.model_dump(mode="json", exclude_defaults=True))
        assert load_scene(tmp_path / "a.yaml") == scene
        assert load_scene(tmp_path / "a.yaml").fingerprint() == scene.fingerprint()

    @pytest.mark.parametrize("seed", [1.0, True, "1"])
    def test_a_seed_is_an_integer(self, seed):
        with pytest.raises(ConfigError, match="`seed` must be an integer, got "):
            draw_scene(family_of(), seed)


class TestRanges:
    @settings(max_examples=60, deadline=None)
    @given(seed=st.integers(-(2**40), 2**40))
    def test_size_place_speed(self, seed):
        group = {
            "count": [1, 4], "size": [0.1, 0.2], "depth": [3, 5], "across": [-0.3, 0.1],
            "up": [0.05, 0.2], "motions": {"linear": 1}, "speed": [0.02, 0.04],
        }  # fmt: skip
        scene = draw_scene(family_of(group), seed)
        assert 1 <= len(scene.bodies) <= 4
        for body in scene.bodies:
            x, y, z = body.position
            wide = -z * WIDTH
            assert 3 - 1e-4 <= -z <= 5 + 1e-4
            assert -0.3 - 1e-4 <= x / wide <= 0.1 + 1e-4
            assert 0.05 - 1e-4 <= (y - 1) / wide <= 0.2 + 1e-4
            assert 0.1 - 1e-4 <= 2 * body.radius / wide <= 0.2 + 1e-4
            speed = (body.velocity[0] ** 2 + body.velocity[1] ** 2) ** 0.5 / wide
            assert 0.02 - 1e-4 <= speed <= 0.04 + 1e-4

    @settings(max_examples=60, deadline=None)
    @given(seed=st.integers(0, 2**40))
    def test_textures(self, seed):
        looks = {
            "kinds": {"checker": 1}, "scale": [0.02, 0.03], "brightness": [0.2, 0.3],
            "contrast": [0.4, 0.5], "saturation": [0, 0.8], "variation": [0.1, 0.2],
        }  # fmt: skip
        family = family_of({"depth": [4, 4]}, textures=looks, exposure=[2, 2])
        for body in draw_scene(family, seed).bodies:
            texture = body.texture
            means = [sum(color) / 3 for color in (texture.color, texture.background)]
            assert 0.4 - 1e-3 <= sum(means) / 2 <= 0.6 + 1e-3
            assert 0.4 - 1e-3 <= abs(means[0] - means[1]) / sum(means) <= 0.5 + 1e-3
            assert 0.02 - 1e-4 <= texture.size / (4 * WIDTH) <= 0.03 + 1e-4
            assert 0.1 <= texture.variation <= 0.2

    def test_chances_and_weights(self):
        family = family_of(
            {"count": [1, 1], "kinds": {"sphere": 3, "box": 1, "capsule": 0}, "glow": 0.25},
            backdrop={"chance": 0.5},
        )
        scenes = [draw_scene(family, seed) for seed in range(600)]
        kinds = [scene.bodies[-1].kind for scene in scenes]
        assert set(kinds) == {"sphere", "box"}
        assert 0.7 < kinds.count("sphere") / 600 < 0.8
        assert 0.2 < sum(scene.bodies[-1].emissive for scene in scenes) / 600 < 0.3
        assert 0.45 < sum(scene.bodies[0].kind == "plane" for scene in scenes) / 600 < 0.55

    def test_bodies_stand_on_the_floor(self):
        family = family_of({"kinds": {"post": 1}, "up": [-0.4, -0.3]}, floor={"chance": 1})
        for seed in range(20):
            for body in draw_scene(family, seed).bodies[1:]:
                assert body.position[1] - body.length / 2 - body.radius > -1e-3


class TestMotions:
    """What is seen on the screen is what the family says."""

    @pytest.mark.parametrize("motion", ["pan", "tilt", "truck"])
    def test_camera(self, motion):
        camera = SIMPLE["camera"] | {"motions": {motion: 1}, "speed": [0.05, 0.05], "subject": 4}
        group = IN_THE_MIDDLE | {"size": [0.3, 0.3], "depth": [4, 4]}
        frame = render_frame(draw_scene(family_of(group, camera=camera), 1), (33, 65), color_spp=1)
        # The middle of the sphere is one radius nearer, which counts where the camera moves.
        radius = 0.5 * 0.3 * 4 * WIDTH
        nearer = 4 / (4 - radius) if motion == "truck" else 1.0
        speed = frame.velocity[0, :, 16, 32].norm()
        assert float(speed) == pytest.approx(0.05 * 65 * nearer, rel=0.02)

    @pytest.mark.parametrize("motion", ["roll", "dolly"])
    def test_camera_at_the_side(self, motion):
        camera = SIMPLE["camera"] | {"motions": {motion: 1}, "speed": [0.05, 0.05], "subject": 4}
        wall = {"chance": 1, "depth": [4, 4]}
        group = {"count": [1, 1], "size": [0.01, 0.01], "across": [0, 0]}
        scene = draw_scene(family_of(group, camera=camera, backdrop=wall), 1)
        frame = render_frame(scene, (33, 65), color_spp=1)
        assert float(frame.velocity[0, :, 16, -1].norm()) == pytest.approx(0.05 * 65, rel=0.05)
        assert float(frame.velocity[0, :, 16, 32].norm()) < 0.1

    def test_arc_keeps_the_subject(self):
        camera = SIMPLE["camera"] | {"motions": {"arc": 1}, "speed": [0.05, 0.05], "subject": 4}
        group = IN_THE_MIDDLE | {"size": [0.02, 0.02], "depth": [4, 4]}
        frame = render_frame(draw_scene(family_of(group, camera=camera), 1), (33, 65), color_spp=1)
        assert float(frame.velocity[0, :, 16, 32].norm()) < 0.2
        assert float(frame.velocity[0, :, 2, 32].norm()) == pytest.approx(0.05 * 65, rel=0.1)

    @pytest.mark.parametrize("motion", ["pan", "roll", "walk", "arc"])
    def test_held_bodies_stand_still_on_the_screen(self, motion):
        camera = SIMPLE["camera"] | {"motions": {motion: 1}, "speed": [0.05, 0.05]}
        group = {"motions": {"held": 1}, "size": [0.3, 0.3], "depth": [2, 2]}
        frame = render_frame(draw_scene(family_of(group, camera=camera), 1), (33, 65), color_spp=1)
        held = frame.object_id[0, 0] > 0
        assert bool(held.any())
        assert float(frame.velocity[0].norm(dim=0)[held].max()) < 1e-3
        assert float(frame.velocity[0].norm(dim=0)[~held].max()) > 1

    def test_bodies(self):
        moved = {}
        for motion in ("linear", "approach", "spin", "tumble", "orbit", "still"):
            group = {"motions": {motion: 1}, "speed": [0.05, 0.05], "depth": [4, 4], "spin": [5, 9]}
            (body, _) = draw_scene(family_of(group), 2).bodies
            moved[motion] = body
            frame = render_frame(draw_scene(family_of(group), 2), (33, 65), color_spp=1)
            fastest = float(frame.velocity.norm(dim=1).max())
            assert fastest == 0 if motion == "still" else 0.3 < fastest < 8, motion
        assert 5 <= abs(moved["spin"].spin) <= 9
        assert moved["spin"].velocity == (0, 0, 0)
        assert moved["linear"].spin == 0
        assert moved["tumble"].spin != 0 != moved["tumble"].velocity[0]
        assert moved["orbit"].pivot is not None
        assert moved["approach"].velocity[:2] == (0, 0)

    @pytest.mark.parametrize("kind", ["wheel", "gear"])
    def test_wheels_turn_about_their_own_axis(self, kind):
        """A disk that turns about its axis stays where it is: its silhouette does not move."""
        group = {"kinds": {kind: 1}, "motions": {"spin": 1}, "spin": [30, 30], "count": [1, 1]}
        for seed in range(3):
            (body,) = draw_scene(family_of(group), seed).bodies
            disk = body.bodies[0] if isinstance(body, Group) else body
            levels = [body.level(), disk.level()] if isinstance(body, Group) else [body.level()]
            (level,) = fold(levels)
            axis = level.at(0).rest @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
            later = level.at(1).rest @ torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
            torch.testing.assert_close(axis, later, atol=1e-4, rtol=0)


class TestAllRender:
    @pytest.mark.parametrize("seed", range(20))
    def test_everyday(self, everyday, seed):
        scene = draw_scene(everyday, seed)
        frame = render_frame(scene, (18, 32), color_spp=1)
        for name, layer in frame.layers().items():
            assert name == "depth" or bool(torch.isfinite(layer).all()), name
        assert not bool(torch.isnan(frame.depth).any())
        reference = render_reference(scene, (18, 32), spp=2).mean
        assert bool(torch.isfinite(reference).all())

    @pytest.mark.parametrize("kind", BodyKind.__args__)
    def test_every_kind(self, kind):
        group = IN_THE_MIDDLE | {"kinds": {kind: 1}, "size": [0.4, 0.4], "thickness": [0.1, 0.1]}
        frame = render_frame(draw_scene(family_of(group), 1), (36, 64), color_spp=1)
        seen = (frame.object_id == 1).float().mean()
        assert 0.005 < float(seen) < 0.3

    def test_every_motion_is_drawn(self):
        every = family_of({"motions": dict.fromkeys(Motion.__args__, 1.0), "count": [4, 4]})
        camera = {"motions": dict.fromkeys(CameraMotion.__args__, 1.0)}
        for seed in range(12):
            render_frame(draw_scene(every, seed), (9, 16), color_spp=1)
            render_frame(draw_scene(family_of(camera=camera), seed), (9, 16), color_spp=1)

    def test_families_that_come_with_torchblur(self, repository):
        paths = sorted((repository / "configs/families").glob("*.yaml"))
        assert [path.stem for path in paths] == ["everyday", "meshes"]
        kinds = {path.stem: set() for path in paths}
        for path in paths:
            family = load_family(path)
            for seed in range(6):
                scene = draw_scene(family, seed)
                kinds[path.stem] |= {type(body) for body, _, _ in scene.placed_bodies()}
                render_frame(scene, (18, 32), color_spp=1)
        assert Mesh in kinds["meshes"]
        assert Mesh not in kinds["everyday"]


def test_everyday_covers_what_is_filmed(everyday):
    """Speeds, moving areas and borders of frames made by hand lie within those of the family."""
    rows = []
    for seed in range(32):
        frame = render_frame(draw_scene(everyday, seed), (68, 120), color_spp=1)
        speed = frame.velocity.norm(dim=1).flatten() * 2  # px/frame at 240 px
        moving = speed[speed > 1]
        sky = float((frame.depth == float("inf")).float().mean())
        band = float(border_band(frame, Shutter(0.5)).float().mean())
        share = moving.numel() / speed.numel()
        rows.append((float(moving.median()), float(moving.quantile(0.95)), share, band, sky))
    slow = sorted(row[0] for row in rows)
    fast = sorted(row[1] for row in rows)
    assert 1 < slow[4] < 4 < statistics.median(slow) < 8 < slow[-4] < 24
    assert 4 < fast[4] < 10 < statistics.median(fast) < 22 < fast[-4] < 45
    shares = sorted(row[2] for row in rows)
    assert shares[3] < 0.15
    assert shares[-8] > 0.95
    assert 0.05 < statistics.quantiles([row[3] for row in rows])[0]
    assert statistics.quantiles([row[3] for row in rows])[2] < 0.5
    assert sum(row[4] > 0.1 for row in rows) >= 5


class TestMistakes:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"size": [0.3, 0.1]}, r"a range is \[low, high\].*0\.3.*groups\.0\.size"),
            ({"size": [0, 0.1]}, r"greater than 0.*groups\.0\.size"),
            ({"kinds": {"sphere": 0}}, r"above 0.*groups\.0\.kinds"),
            ({"kinds": {}}, r"groups\.0\.kinds"),
            ({"kinds": {"spere": 1}}, r"spere"),
            ({"motions": {"still": -1}}, r"greater than or equal to 0.*motions\.still"),
            ({"count": [0, 0]}, "one group at least must have a body"),
            ({"glow": 1.5}, r"less than or equal to 1, got 1\.5 \(groups\.0\.glow\)"),
            (
                {"sped": [1, 2]},
                r"unknown key `sped` \(did you mean `speed`\?\) \(groups\.0\.sped\)",
            ),
        ],
    )
    def test_of_a_group(self, change, message):
        with pytest.raises(ConfigError, match=message):
            family_of(change)

    def test_of_the_family(self):
        group = SIMPLE["groups"][0]
        with pytest.raises(ConfigError, match="groups must have different names"):
            family_of(groups=[group, group])
        with pytest.raises(ConfigError, match=r"less than or equal to 150, got 170.*camera\.fov"):
            family_of(camera={"fov": [40, 170]})

    def test_of_the_file(self, tmp_path):
        path = tmp_path / "a.yaml"
        with pytest.raises(ConfigError, match=r"the family .*a\.yaml cannot be read"):
            load_family(path)
        path.write_text("[1, 2]")
        with pytest.raises(
            ConfigError, match=r"a family must be a mapping with `groups`, got list"
        ):
            load_family(path)
        path.write_text("groups: []\n")
        with pytest.raises(ConfigError, match=r"`groups`.*a\.yaml: groups"):
            load_family(path)
