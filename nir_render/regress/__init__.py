"""Regression image sets: references of a suite of scenes, and whether what is rendered now is still the same.

regress.create("scenes/regression")
result = regress.check("scenes/regression")        # result.holds, result.scenes[0].findings
regress.update("scenes/regression", reason="the floor is darker now")
"""

from nir_render.regress.checking import FALSE_ALARM_RATE, check
from nir_render.regress.findings import Check, Finding, SceneCheck, Update
from nir_render.regress.update import create, update

__all__ = ["FALSE_ALARM_RATE", "Check", "Finding", "SceneCheck", "Update", "check", "create", "update"]
