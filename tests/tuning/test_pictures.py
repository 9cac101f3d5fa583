from tuning.pictures import picture_of


def test_a_picture_has_five_labeled_images_side_by_side():
    page = picture_of("fence", size=(18, 32), spp=2)
    assert page.size == (5 * 36 - 4, 18 + 22)
    assert len(page.getcolors(100_000)) > 100
