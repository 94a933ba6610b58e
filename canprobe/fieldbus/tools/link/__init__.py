"""The link verdict: whether a bus, its nodes and this machine hold a cycle, and if not, why.

A `LinkMeter` stands between a master's cycle and its port, and notes when each SYNC was sent, when each node answered,
and what else was on the bus. Its `LinkFigures` are judged by `judge_link`: fit, marginal or unfit for the rate of the
cycle, with the cause, what to type, the rate that would be fit, and the overruns to expect at other rates.
`machine_facts` is what the machine says about itself; what it does not say is "not available".

What the words mean is what the next minute of the cell shows: *fit*, nothing is missed and at most 0.1 % of the cycles
overrun; *unfit*, the cell is stopped, or more than 2 % overrun; *marginal* lies between. An overrun is a SYNC that is
sent more than half a period late.

The figures come from a cycle of the plan's own traffic with the drives disabled. They do not see what only motion
brings: the work of the task's controller, noise of powered motors on the cable, a node that is busy when it moves.

    figures   what was measured
    meter     the port that measures
    verdict   figures → verdict, and overruns at another rate
    machine   facts of the machine

The room uses the standard library only, and sends nothing itself. Start reading at `verdict`.
"""

from canprobe.fieldbus.tools.link.figures import AnswerFigures, LinkFigures
from canprobe.fieldbus.tools.link.meter import LinkMeter
from canprobe.fieldbus.tools.link.verdict import Fitness, LinkLimits, LinkVerdict, judge_link

__all__ = ["AnswerFigures", "Fitness", "LinkFigures", "LinkLimits", "LinkMeter", "LinkVerdict", "judge_link"]
