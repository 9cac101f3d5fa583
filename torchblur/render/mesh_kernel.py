"""The warp kernel that finds the triangle a ray meets first; warp is imported with this module.

One kernel serves CPU and CUDA. Warp keeps what it compiles in its own cache folder.
"""

import os
import sys
import threading
from typing import Any

import torch
import warp
from torch import Tensor

__all__ = ["Bvh"]

wp: Any = warp  # its types are not those of its kernels


def _start() -> None:
    """Start warp without a word: what commands print is for other programs, too."""
    for name, value in (("quiet", True), ("log_level", 30)):  # older versions, newer ones
        if hasattr(wp.config, name):
            setattr(wp.config, name, value)
    if torch.cuda.is_available():
        wp.init()
        return
    # Its native code writes that there is no CUDA driver, which is no news.
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


_start()

_ONE_AT_A_TIME = threading.Lock()  # warp's CPU launches are not thread-safe


@wp.kernel(enable_backward=False)  # type: ignore[untyped-decorator]
def _closest(
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
    directions: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
    limits: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    distances: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    faces: wp.array(dtype=wp.int32),  # type: ignore[valid-type]
) -> None:
    ray = wp.tid()
    query = wp.mesh_query_ray(mesh, origins[ray], directions[ray], limits[ray])
    if query.result:
        distances[ray] = query.t
        faces[ray] = query.face
    else:
        faces[ray] = -1


class Bvh:
    """Triangles in a bounding volume hierarchy on one device.

    Args:
        corners: Positions, float32, (F, 3, 3), on the device.
    """

    def __init__(self, corners: Tensor) -> None:
        points = corners.reshape(-1, 3).contiguous()
        indices = torch.arange(len(points), dtype=torch.int32, device=points.device)
        self._tensors = (points, indices)  # warp has no copy
        with _ONE_AT_A_TIME, _stream(points):
            self._mesh = wp.Mesh(
                points=wp.from_torch(points, dtype=wp.vec3), indices=wp.from_torch(indices)
            )

    def closest(self, origins: Tensor, directions: Tensor, limits: Tensor) -> tuple[Tensor, Tensor]:
        """Return distance and triangle of the first hit of each ray, -1 for none, (N,) each.

        Args:
            origins: Float32, (N, 3).
            directions: Unit vectors, float32, (N, 3).
            limits: Largest distance that counts, float32, (N,).
        """
        count = len(origins)
        distances = torch.full_like(limits, torch.inf)
        faces = torch.full((count,), -1, dtype=torch.int32, device=limits.device)
        if not count:
            return distances, faces
        vectors = [wp.from_torch(v.contiguous(), dtype=wp.vec3) for v in (origins, directions)]
        numbers = [wp.from_torch(t) for t in (limits.contiguous(), distances, faces)]
        with _ONE_AT_A_TIME, _stream(limits):
            wp.launch(
                _closest,
                dim=count,
                inputs=[self._mesh.id, *vectors, *numbers],
                device=wp.device_from_torch(limits.device),
            )
        return distances, faces


def _stream(like: Tensor) -> Any:
    """Return a context in which warp works on torch's stream, so that neither need wait."""
    if not like.is_cuda:
        return wp.ScopedDevice("cpu")
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(like.device)))
