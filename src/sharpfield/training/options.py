"""How to train, whatever the recipe: the options that every training command has."""

from dataclasses import dataclass

from sharpfield.core.errors import OptionError


@dataclass(frozen=True)
class TrainingOptions:
    """How to train, whatever the recipe."""

    steps: int | None = None
    """Length of the run; None for what the recipe says, or what `minutes` allow."""
    minutes: float | int | None = None
    """Time for this session. A new run gets a schedule that fits into it."""
    resume: bool = False
    """Go on with the run in the folder, if there is one."""
    checkpoint_every: int | None = None
    """Steps between checkpoints; None for one a minute."""
    log_every: int = 10
    """Steps whose losses are averaged to one row of the log."""
    validate_every: int = 1000
    """Steps between validations, where there is something to validate with."""
    memory_gb: float | None = None
    """Memory for training, in GiB; None for most of what is free."""

    def __post_init__(self) -> None:
        if self.steps is not None and self.minutes is not None:
            raise OptionError("`steps` and `minutes` exclude each other", do="give one of them")
        for name, value in vars(self).items():
            if isinstance(value, int | float) and name != "resume" and not value > 0:
                raise OptionError(f"`{name}` must be positive", got=value)
