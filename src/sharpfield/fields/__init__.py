"""Fields: what a sharp scene emits, at points, in directions, at times."""

from sharpfield.fields.gaussians import Gaussians
from sharpfield.fields.mlp import MLPField
from sharpfield.fields.plane_grid import HeadSize, PlaneField, Volume
from sharpfield.fields.voxel_grid import VoxelGrid

__all__ = ["Gaussians", "HeadSize", "MLPField", "PlaneField", "Volume", "VoxelGrid"]
