"""What the machine says about itself: kernel, governor, real-time rights, other load, timer slack, driver and queue.

A value that the machine does not give is `NOT_AVAILABLE`: a guest has no governor, a container hides files of /sys.
"""

from __future__ import annotations

import platform
from pathlib import Path

from canprobe.fieldbus.bus.system import system

NOT_AVAILABLE = "not available"


def machine_facts(channel: str | None = None) -> dict[str, str]:
    """Facts of this machine, and of the driver of an interface.

    Args:
        channel: SocketCAN interface; None leaves its facts out.
    """
    facts = {
        "kernel": f"{platform.release()}, {'PREEMPT_RT' if _read('/sys/kernel/realtime') == '1' else _preemption()}",
        "processors": str(system.processors()),
        "governor": _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"),
        "frequency_khz": _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_cur_freq"),
        "load": _read("/proc/loadavg").split(" ")[0],
        "timer_slack_ns": _read("/proc/self/timerslack_ns"),
        "realtime_priority": _limit("RLIMIT_RTPRIO"),
        "locked_memory": _limit("RLIMIT_MEMLOCK"),
    }
    if channel is not None:
        driver = Path(f"/sys/class/net/{channel}/device/driver")
        facts["driver"] = driver.resolve().name if driver.exists() else NOT_AVAILABLE
        facts["transmit_queue"] = _read(f"/sys/class/net/{channel}/tx_queue_len")
    return facts


def _preemption() -> str:
    version = platform.version()
    return next((word for word in ("PREEMPT_DYNAMIC", "PREEMPT") if word in version), "no PREEMPT_RT")


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii", errors="replace").strip() or NOT_AVAILABLE
    except OSError:
        return NOT_AVAILABLE


def _limit(name: str) -> str:
    """Soft limit of a resource: for real time, the highest priority that may be asked for; root may take any."""
    soft = system.soft_limit(name)
    return NOT_AVAILABLE if soft is None else "any, as root" if system.is_root() else soft
