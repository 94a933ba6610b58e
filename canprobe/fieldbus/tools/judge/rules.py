"""All rules, in the order of their numbers, and what of the list of faults is no rule."""

from __future__ import annotations

from canprobe.fieldbus.tools.judge import enable, homing_rules, network_rules, pdo_rules, reactions, sdo_rules, targets
from canprobe.fieldbus.tools.judge.rule import BusRule, Rule

_MODULES = (enable, targets, pdo_rules, network_rules, sdo_rules, homing_rules, reactions)
_FOUND = {
    one
    for module in _MODULES
    for one in vars(module).values()
    if isinstance(one, type) and issubclass(one, Rule) and one not in (Rule, BusRule)
}
RULES: tuple[type[Rule], ...] = tuple(sorted(_FOUND, key=lambda rule: rule.number))
NO_RULES: tuple[tuple[str, str], ...] = (
    ("12 enabling as part of initialisation", "the bus does not show whether a person asked for it"),
)
"""Known faults of masters that are not judged, and why."""
