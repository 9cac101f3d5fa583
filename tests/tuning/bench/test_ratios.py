"""Lines through rows and ratios between them, on figures that are planted."""

import math

import pytest

from tuning.bench.cases import Case, Row, cost_of
from tuning.bench.ratios import fits_of, linear_fit, with_ratios

GUERTIN = Case(filter="guertin2014", num_samples=35, width=1000, height=1000)


def row(cpu_s=1.0, **changes):
    of_row = {k: changes.pop(k) for k in ("device_ms", "peak_mib", "wall_s") if k in changes}
    return Row(case=GUERTIN.but(**changes), cpu_s=cpu_s, **of_row)


def by_key(*rows):
    return {r.case.key: r for r in rows}


class TestLinearFit:
    def test_recovers_a_planted_line(self):
        fit = linear_fit("x", "N", [(n, 0.3 + 0.02 * n) for n in (19, 27, 35, 47)])
        assert fit.intercept == pytest.approx(0.3)
        assert fit.slope == pytest.approx(0.02)
        assert fit.r2 == pytest.approx(1)
        assert fit.residual == pytest.approx(0, abs=1e-12)
        assert fit.points == 4

    def test_measures_what_the_line_misses(self):
        # +d, -d, -d, +d on 0, 1, 2, 3 is orthogonal to every line
        points = [(x, 5 + 2 * x + d) for x, d in enumerate((0.4, -0.4, -0.4, 0.4))]
        fit = linear_fit("x", "N", points)
        assert (fit.intercept, fit.slope) == pytest.approx((5, 2))
        assert fit.residual == pytest.approx(0.4 / 8)
        assert fit.r2 == pytest.approx(1 - 4 * 0.16 / (20 + 4 * 0.16))

    def test_says_nothing_of_two_points(self):
        fit = linear_fit("x", "N", [(1, 3.0), (2, 5.0)])
        assert (fit.intercept, fit.slope) == pytest.approx((1, 2))
        assert fit.r2 is None
        assert fit.residual is None

    @pytest.mark.parametrize("points", [[], [(1, 2.0)], [(1, 2.0), (1, 3.0)]])
    def test_needs_two_places(self, points):
        assert linear_fit("x", "N", points) is None


class TestFits:
    def test_by_taps_for_each_filter(self):
        rows = [row(0.1 + 0.01 * n, num_samples=n) for n in (19, 27, 35)]
        rows += [row(0.002 * n, num_samples=n, filter="line") for n in (19, 27, 35)]
        rows.append(Row(case=GUERTIN.but(num_samples=47), error="no memory"))
        guertin, line = fits_of("taps", rows)
        assert (guertin.intercept, guertin.slope) == pytest.approx((100, 10))
        assert (guertin.points, guertin.x, guertin.unit) == (3, "N", "ms")
        assert (line.intercept, line.slope) == pytest.approx((0, 2), abs=1e-9)
        assert (guertin.name, line.name) == (
            "guertin2014 eager forward 1000x1000",
            "line eager forward 1000x1000",
        )

    def test_by_pixels(self):
        sizes = [(1000, 500), (1000, 1000), (2000, 2000)]
        rows = [row(0.5 + 2e-6 * w * h, width=w, height=h) for w, h in sizes]
        (fit,) = fits_of("sizes", rows)
        assert (fit.intercept, fit.slope, fit.x) == (pytest.approx(500), pytest.approx(2000), "Mpx")

    def test_by_moving_area(self):
        (fit,) = fits_of("moving", [row(0.01 + 0.03 * p, moving=p) for p in (0, 10, 50, 100)])
        assert (fit.intercept, fit.slope) == pytest.approx((10, 30))

    def test_takes_the_devices_time_where_there_is_one(self):
        rows = [row(9.0, num_samples=n, device_ms=1.0 + n) for n in (19, 27, 35)]
        (fit,) = fits_of("taps", rows)
        assert (fit.intercept, fit.slope) == pytest.approx((1, 1))

    def test_only_tables_that_vary_something(self):
        assert fits_of("filters", [row(num_samples=n) for n in (1, 2)]) == []


class TestRatios:
    def test_are_this_over_that(self):
        measured = by_key(
            row(8.0, engine="eager"),
            row(2.0, engine="compiled", peak_mib=10.0),
            row(6.0, engine="compiled", what="backward", peak_mib=25.0),
            row(0.5, engine="compiled", moving=10),
            Row(case=Case(kind="copy", width=1000, height=1000), cpu_s=0.25),
        )
        eager, compiled, backward, some, copy = with_ratios(list(measured.values()), measured)
        assert eager.ratios["of_eager"] == 1
        assert compiled.ratios["of_eager"] == 0.25
        assert compiled.ratios["of_copy"] == 8
        assert backward.ratios["of_forward"] == 3
        assert backward.ratios["memory_of_forward"] == 2.5
        assert some.ratios["of_whole"] == 0.25
        assert "memory_of_forward" not in compiled.ratios
        assert copy.ratios == {}

    def test_of_one_call_to_many(self):
        apart, one = row(6.0, sets=32, apart=True), row(1.5, sets=32)
        _, found = with_ratios([apart, one], by_key(apart, one))
        assert found.ratios["of_apart"] == 0.25

    def test_of_variants(self):
        full = row(4.0, params={"resolution": "full", "directions": "two"})
        half = row(1.0, params={"resolution": "half", "directions": "one"})
        assert with_ratios([half], by_key(full, half))[0].ratios["of_full_two"] == 0.25

    def test_none_to_what_is_not_measured(self):
        alone = row(what="backward", engine="compiled")
        failed = Row(case=alone.case.but(what="forward"), error="no memory")
        (found,) = with_ratios([alone], by_key(alone, failed))
        assert set(found.ratios) == {"of_whole"}  # itself


def test_cost_is_device_time_or_cpu_time():
    assert cost_of(row(2.0, wall_s=1.0)) == 2
    assert cost_of(row(2.0, device_ms=500.0)) == 0.5
    assert cost_of(None) is None
    assert not math.isnan(cost_of(row()))
