"""The cache of rendered frames, shared by several machines."""

import torch

from tuning.data import cache


def test_two_machines_do_not_write_one_file(monkeypatch):
    """Processes of one number on two machines, each in the middle of writing the same frame."""
    written = []
    save = torch.save

    def saving(tensors, path):
        written.append(path)
        if len(written) == 1:  # the other one comes just now
            cache.cached("same", lambda: {"x": torch.ones(3)})
        save(tensors, path)

    monkeypatch.setattr(torch, "save", saving)
    cache.cached("same", lambda: {"x": torch.ones(3)})
    assert len(set(written)) == 2
    assert {path.parent for path in written} == {cache.cache_folder() / "frames"}
    left = sorted(path.name for path in written[0].parent.glob("*same*"))
    assert left == ["same.pt"]
    found = cache.cached("same", lambda: {"x": torch.zeros(3)})
    assert found["x"].tolist() == [1, 1, 1]
