"""Options of the recipes on Gaussians under their former names, for hints on the command line.

The first entry that fits counts: single options come before their group.
"""

_MOVING = {
    "looks.still": "motion.static_warmup",
    "looks.alone": "sampling.event_only_weight",
    "gaussians.density_moving": "motion.density",
    "gaussians.span_ms": "motion.lifespan_ms",
    "gaussians.idle_moving": "motion.reg",
    "gaussians.fleeting": "motion.lifespan_penalty",
    "gaussians.spans_rate": "motion.lifespan_lr",
}

RENAMED = {
    "looks.instants": "sampling.grad_views",
    "looks.draws": "sampling.views",
    "looks.early": "sampling.edi_phase",
    "looks.still": "sampling.sharp_warmup",
    "looks.sharp": "sampling.latent_weight",
    "looks.windows": "sampling.event_weight",
    "looks.fading": "sampling.final_event_weight",
    "looks.shortest_us": "sampling.min_window_us",
    "looks.longest_us": "sampling.max_window_us",
    "looks.depth": "sampling.depth_weight",
    "looks.quality": "sampling.frame_quality",
    "looks.part": "sampling.crop",
    "looks": "sampling",
    "unknowns.rate": "calibration.lr",
    "unknowns.poses_rate": "calibration.poses_lr",
    "unknowns.offset_rate_us": "calibration.offset_lr_us",
    "unknowns": "calibration",
    "gaussians.budget": "gaussians.cap_max",
    "gaussians.degree": "gaussians.sh_degree",
    "gaussians.size": "gaussians.scale",
    "gaussians.idle": "gaussians.reg",
    "gaussians.rates": "gaussians.lr",
}
"""Of recipes for static scenes."""

RENAMED_MOVING = _MOVING | {old: new for old, new in RENAMED.items() if old not in _MOVING}
"""Of recipes for moving scenes."""
