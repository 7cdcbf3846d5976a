"""Numerical kernels as pure functions: one file per operation, plain torch or numpy first.

Faster versions live in `ops/fast/`. Inside the project a file is a namespace, as in
`from sharpfield.ops import compositing, stepfun`; for others the most useful functions are here.
"""

from typing import TYPE_CHECKING

from sharpfield._lazy import lazily

if TYPE_CHECKING:
    from sharpfield.ops._dispatch import using as using
    from sharpfield.ops.compositing import composite as composite
    from sharpfield.ops.encoding import frequencies as frequencies
    from sharpfield.ops.encoding import spherical_harmonics as spherical_harmonics
    from sharpfield.ops.hash_grid import hash_features as hash_features
    from sharpfield.ops.hash_grid import hash_layout as hash_layout
    from sharpfield.ops.knn import neighbours as neighbours
    from sharpfield.ops.rasterizer import Canvas as Canvas
    from sharpfield.ops.rasterizer import rasterize as rasterize
    from sharpfield.ops.voxel_march import march_voxels as march_voxels

__getattr__, __dir__ = lazily(__name__, __file__, check_shapes=True)
