"""All rules, in the order of their numbers, and what of the list of faults is no rule."""

from __future__ import annotations

from canprobe.fieldbus.tools.judge.enable import ENABLE_RULES
from canprobe.fieldbus.tools.judge.homing_rules import HOMING_RULES
from canprobe.fieldbus.tools.judge.nmt_rules import NMT_RULES
from canprobe.fieldbus.tools.judge.pdo_rules import PDO_RULES
from canprobe.fieldbus.tools.judge.reactions import REACTION_RULES
from canprobe.fieldbus.tools.judge.rule import Rule
from canprobe.fieldbus.tools.judge.sdo_rules import SDO_RULES
from canprobe.fieldbus.tools.judge.supervision import SUPERVISION_RULES
from canprobe.fieldbus.tools.judge.sync_rules import SYNC_RULES
from canprobe.fieldbus.tools.judge.targets import TARGET_RULES

RULES: tuple[type[Rule], ...] = tuple(
    sorted(
        (
            *ENABLE_RULES,
            *TARGET_RULES,
            *PDO_RULES,
            *NMT_RULES,
            *SYNC_RULES,
            *SDO_RULES,
            *HOMING_RULES,
            *REACTION_RULES,
            *SUPERVISION_RULES,
        ),
        key=lambda rule: rule.number,
    )
)
NO_RULES: tuple[tuple[str, str], ...] = (
    ("12 enabling as part of initialisation", "the bus does not show whether a person asked for it"),
)
"""Known faults of masters that are not judged, and why."""
