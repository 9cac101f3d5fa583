import pytest

from tools.readme_images import one_sample_per_pixel, tuned_beside_published, what_lies_behind


@pytest.mark.parametrize(
    ("make", "columns"),
    [
        (lambda: tuned_beside_published("fence", size=(18, 32), spp=2), 6),
        (lambda: what_lies_behind(size=(18, 32), spp=2), 5),
        (lambda: one_sample_per_pixel(size=(18, 32), spp=2, frames=2), 4),
    ],
    ids=["tuned", "behind", "stream"],
)
def test_a_picture_has_labeled_images_side_by_side(make, columns):
    page = make()
    assert page.size == (columns * 36 - 4, 18 + 22)
    assert len(page.getcolors(100_000)) > 100
