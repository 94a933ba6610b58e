"""What Linux, macOS and Windows have under different names, under one: `system`, a module.

- `TERMINATION_SIGNALS`: signals that end a process from outside: a service is stopped, a terminal is closed.
- `END_SIGNALS`: signals that end a child, each stronger than the one before; the last one cannot be ignored: `KILL`.
- `OWN_SESSION`: arguments of `subprocess.Popen` for a child that Ctrl-C does not reach.
- `NON_BLOCKING_PIPES`: whether a pipe can be written without waiting.
- `lock(file)`: lock an open file until it is closed; `BlockingIOError` where another process has it.
- `monotonic_ns()`: a clock that all processes share, never set, finer than 1 µs.
- `typed(descriptor)`: what a terminal or pipe has to read, without waiting, and whether more may come.
- `write_some(descriptor, data, patience_s)`: write as much as a reader takes within that time; how many bytes it took,
  `OSError` where nobody reads any more.
- `enlarge_pipe(fd, size)`: ask for a pipe of so many bytes.
- `interrupts_blocked()`: a block in which SIGINT is not received; processes that it starts never receive one.
- `end_process(process, number)`, `end_session(process, number)`: send a signal to a child; to all of its session.
- `end_with_parent(parent, number)`: called in a child: receive the signal when the process `parent` ends, or at once
  where it has ended. Linux only, a second line of defence.
- `processors()`: number of processors that this process may use.
- `is_root()`: whether everything is permitted.
- `soft_limit(name)`: limit of a resource, such as "RLIMIT_MEMLOCK"; None where there is no such resource.
- `ioctl(fd, request, argument)`: a request to a network interface; its answer.
- `c_library()`: the C library, for calls that Python lacks; None where it has none of them.
"""

from __future__ import annotations

try:
    from canprobe.fieldbus.bus import posix as system
except ImportError:  # there is no fcntl
    from canprobe.fieldbus.bus import windows as system  # type: ignore[no-redef]

__all__ = ["system"]
