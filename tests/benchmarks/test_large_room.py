import importlib

import pytest

from benchmarks.large_room import STAGES


@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_is_a_function_that_exists(stage: str):
    module, function = STAGES[stage]
    assert callable(getattr(importlib.import_module(module), function))
