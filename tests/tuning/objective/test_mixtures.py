"""Families among the data of a fit, the split by scene, and what each item counts."""

import dataclasses

import pytest
import torch
from planted import FIXED, PLANTED, planted_case, tiny_frame, write_planted

import tuning.data.loading
from torchblur.errors import ConfigError
from torchblur.filters import get_filter
from torchblur.io import save_yaml, write_frame, write_image
from torchblur.params import build
from torchblur.render import draw_scene, load_family
from tuning.config.data import DataSpec
from tuning.config.fit import TuneConfig, resolve
from tuning.config.objective import ObjectiveSpec
from tuning.data.loading import load_cases
from tuning.fit.run import run_fit
from tuning.objective.problem import Problem
from tuning.objective.windows import make_samples, window_weights

FAMILY = """
groups:
  - {name: movers, count: [1, 2], kinds: {sphere: 1, box: 1}, motions: {linear: 1}, depth: [3, 5]}
"""
QUICK = {"size": "24x16", "spp": 4, "color_spp": 2}
PLAIN = ObjectiveSpec(terms={"mse": 1.0}, color_space="linear")


@pytest.fixture
def root(tmp_path, monkeypatch):
    (tmp_path / "family.yaml").write_text(FAMILY)
    monkeypatch.setenv("TORCHBLUR_CACHE", str(tmp_path / "cache"))
    return tmp_path


def family(**more):
    return {"kind": "family", "path": "family.yaml", "scenes": 2, **QUICK, **more}


def spec_of(root, **sections) -> DataSpec:
    return build(DataSpec, {"root": str(root), **sections})


class TestFamilies:
    def test_scenes_are_drawn_one_seed_after_the_other(self, root):
        spec = spec_of(root, train=[family(seed=3, frames=[0, 1])], holdout=[family(seed=5)])
        cases = load_cases(spec)
        assert [(c.name, c.split) for c in cases] == [
            ("family-0003 0", "train"), ("family-0003 1", "train"),
            ("family-0004 0", "train"), ("family-0004 1", "train"),
            ("family-0005 0", "holdout"), ("family-0006 0", "holdout"),
        ]  # fmt: skip
        assert len({case.origin for case in cases}) == 4
        assert {case.size for case in cases} == {(16, 24)}

    def test_is_what_the_file_of_the_drawn_scene_gives(self, root):
        drawn = load_cases(spec_of(root, train=[family(seed=3, scenes=1)]))[0]
        scene = draw_scene(load_family(root / "family.yaml"), 3)
        save_yaml(root / "a.yaml", scene.model_dump(mode="json", exclude_defaults=True))
        item = {"kind": "scene", "path": "a.yaml", "seed": 3, **QUICK}
        given = load_cases(spec_of(root, train=[item]))[0]
        assert torch.equal(drawn.reference, given.reference)
        assert drawn.origin == given.origin
        with pytest.raises(ConfigError, match=r"same frame is in data\.train and data\.holdout"):
            load_cases(spec_of(root, train=[family(seed=3)], holdout=[item]))

    def test_rendered_once(self, root, monkeypatch):
        load_cases(spec_of(root, train=[family(seed=3, scenes=3)]))

        def fail(*args, **kwargs):
            raise AssertionError("rendered again")

        monkeypatch.setattr(tuning.data.loading, "render_reference", fail)
        again = load_cases(spec_of(root, train=[family(seed=4, weight=2.0)]))
        assert [case.name for case in again] == ["family-0004 0", "family-0005 0"]
        # It is the drawn scenes that count, not the file.
        (root / "family.yaml").write_text(f"# everyday\n{FAMILY}")
        load_cases(spec_of(root, train=[family(seed=4)]))
        (root / "family.yaml").write_text(FAMILY.replace("[3, 5]", "[4, 5]"))
        with pytest.raises(AssertionError, match="rendered again"):
            load_cases(spec_of(root, train=[family(seed=4)]))

    def test_sequences(self, root):
        item = family(kind="family_stream", seed=3, frames=[0, 1, 2], warm_up=1)
        cases = load_cases(spec_of(root, train=[item]))
        assert [(case.name, len(case), case.seed) for case in cases] == [
            ("family-0003 0-2", 3, 3),
            ("family-0004 0-2", 3, 4),
        ]

    def test_missing_family(self, root):
        with pytest.raises(
            ConfigError, match=r"family .*b\.yaml does not exist; in .*family\.yaml"
        ):
            load_cases(spec_of(root, train=[family(path="b.yaml")]))


class TestSplit:
    @pytest.mark.parametrize("kinds", [("family", "family"), ("family", "family_stream")])
    @pytest.mark.parametrize(("first", "second"), [(3, 4), (4, 3), (3, 3)])
    def test_seeds_in_both(self, root, first, second, kinds):
        items = [
            family(kind=kind, seed=seed, frames=[0])
            for kind, seed in zip(kinds, (first, second), strict=True)
        ]
        ranges = rf"train\.0 has {first} to {first + 1}, holdout\.0 has {second} to {second + 1}"
        with pytest.raises(ConfigError, match=f"seeds of families .* must differ: {ranges}"):
            spec_of(root, train=items[:1], holdout=items[1:])

    def test_neighbors_are_fine(self, root):
        scene = {"kind": "scene", "path": "a.yaml", "seed": 3}
        spec_of(root, train=[family(seed=3), scene], holdout=[family(seed=5), family(seed=1)])

    def test_a_scene_twice_in_the_fit(self, root):
        with pytest.raises(ConfigError, match=r"stands twice in data\.train: 'family-0004 0'"):
            load_cases(spec_of(root, train=[family(seed=3), family(seed=4)]))


def cases_of(*items):
    """Return a case per (item, weight)."""
    return [
        dataclasses.replace(planted_case(seed), item=item, weight=weight)
        for seed, (item, weight) in enumerate(items, start=1)
    ]


class TestWeights:
    def test_by_hand(self):
        """Items of weight 3 and 1 (left out): two frames of four windows, one frame of two."""
        cases = cases_of(("a", 3.0), ("a", 3.0), ("b", None))
        weights = window_weights(cases, [4, 4, 2])
        # 10 windows; a has 3/4 of 10 in 8 windows, b 1/4 of 10 in 2.
        assert weights == pytest.approx([7.5 / 8, 7.5 / 8, 2.5 / 2])

    def test_without_any_all_count_alike(self):
        assert window_weights(cases_of(("a", None), ("b", None)), [4, 1]) == [1.0, 1.0]

    @pytest.mark.parametrize("count", [1, 3])
    def test_objective_by_hand(self, count):
        cases = cases_of(("a", 3.0), ("b", 1.0), ("b", 1.0))
        for number, case in enumerate(cases):
            wrong = case.reference + 0.1 * (number + 1)
            cases[number] = dataclasses.replace(case, reference=wrong)
        blur = get_filter("guertin2014")(**FIXED, **PLANTED).requires_grad_(False)
        samples = make_samples(cases, None, tile_size=12, seed=0)
        values = {"kappa": torch.full((count,), PLANTED["kappa"])}
        found = Problem(blur, samples, PLAIN).mean(values, count)
        want = (3 * 0.1**2 + 0.5 * 0.2**2 + 0.5 * 0.3**2) / 4
        torch.testing.assert_close(found, torch.full((count,), want).double(), rtol=1e-4, atol=0)

    def test_gradients_count_alike(self):
        """The weight is in the gradient, and batches of windows have it on average."""
        cases = cases_of(("a", 3.0), ("b", 1.0))
        blur = get_filter("guertin2014")(**FIXED).requires_grad_(False)
        samples = make_samples(cases, None, tile_size=12, seed=0)
        grads = []
        for some, chosen in ((samples, None), (samples, [0]), (samples, [1])):
            kappa = torch.tensor([9.0], requires_grad=True)
            sum(Problem(blur, some, PLAIN).losses({"kappa": kappa}, 1, chosen)).sum().backward()
            grads.append(float(kappa.grad))
        assert grads[0] == pytest.approx((grads[1] + grads[2]) / 2, rel=1e-4)
        unweighted = Problem(blur, make_samples(cases[:1], None, tile_size=12, seed=0), PLAIN)
        kappa = torch.tensor([9.0], requires_grad=True)
        sum(unweighted.losses({"kappa": kappa}, 1)).sum().backward()
        assert grads[1] == pytest.approx(1.5 * float(kappa.grad), rel=1e-4)

    def test_sequences_have_them_too(self, root):
        item = family(kind="family_stream", scenes=1, frames=[0, 1])
        light = load_cases(spec_of(root, train=[item]))
        both = load_cases(spec_of(root, train=[item | {"weight": 3.0}, item | {"seed": 1}]))
        blur = get_filter("line")()
        plain = make_samples(light, None, tile_size=4, seed=0, blur=blur)
        weighted = make_samples(both, None, tile_size=4, seed=0, blur=blur)
        assert [sample.weight for sample in weighted] == [1.5, 0.5]
        first = Problem(blur, plain, PLAIN).mean({})
        heavy = Problem(blur, weighted[:1], PLAIN).mean({})
        torch.testing.assert_close(heavy, 1.5 * first)

    def test_a_fit_leans_to_the_heavier_item(self, root):
        """Two items ask for different values; the result is nearer to what the heavier asks for."""
        data = write_planted(root / "frames")
        config = data | {
            "filter": {"kind": "guertin2014", "params": FIXED | PLANTED, "free": ["kappa"]},
            "methods": [{"kind": "gradient", "steps": 12, "starts": 1, "learning_rate": 0.05}],
        }
        found = []
        for weights in ((50.0, 1.0), (1.0, 50.0)):
            items = [
                {"kind": "exr", "path": name, "shutter": 1.0, "weight": weight}
                for name, weight in zip(("first", "other"), weights, strict=True)
            ]
            _write_other(root / "frames" / "other")
            config["data"] = {"root": str(root / "frames"), "train": items}
            out = root / f"run {weights[0]:g}"
            found.append(run_fit(build(TuneConfig, config), out).params["kappa"])
        assert found[0] < 3.6
        assert found[1] > 4.5

    @pytest.mark.parametrize("weight", [0, -1])
    def test_a_weight_is_positive(self, root, weight):
        with pytest.raises(
            ConfigError, match=rf"greater than 0, got {weight} \(train\.0\.weight\)"
        ):
            spec_of(root, train=[family(weight=weight)])

    def test_not_in_the_hold_out(self, root):
        with pytest.raises(ConfigError, match=r"`weight` counts in the fit.*got 2 in holdout\.0"):
            spec_of(root, train=[family()], holdout=[family(seed=9, weight=2.0)])

    @pytest.mark.parametrize("crops", [None, {"unbiased": True}])
    def test_not_of_the_worst(self, root, crops):
        data = write_planted(root / "frames")
        data["data"] |= {"crops": crops}
        if crops is None:
            data["data"]["train"][0]["weight"] = 2.0
        data["objective"] = {"reduction": "worst"}
        with pytest.raises(
            ConfigError, match=r"belong to a mean, got 'worst' \(a\.yaml: objective"
        ):
            resolve(build(TuneConfig, data), "a.yaml")


def _write_other(folder):
    """Write a case that asks for another kappa than the planted one."""
    if folder.is_dir():
        return
    folder.mkdir(parents=True)
    frame = tiny_frame(2)
    with torch.no_grad():
        image = get_filter("guertin2014")(**FIXED | PLANTED | {"kappa": 8.0})(frame, shutter=1.0)
    write_frame(folder / "sharp.exr", frame, half=False)
    write_image(folder / "reference.exr", image, half=False)
