"""Recipes: one paper, one file. A package of your own can add some by an entry point."""

from sharpfield.recipes.ev_deblur_nerf import EvDeblurNeRF
from sharpfield.recipes.nerf import NeRF

RECIPES = {"nerf": NeRF, "ev-deblur-nerf": EvDeblurNeRF}
"""By the name that the command line knows."""

__all__ = ["RECIPES", "EvDeblurNeRF", "NeRF"]
