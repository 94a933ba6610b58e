"""A command in a user-mode Linux guest: a kernel with CAN as an ordinary process on the files of this machine.

The root of the guest is the file system of the machine (hostfs), with the same programs, interpreters and folders; the
guest has a vcan0 and a vcan1. The output of the command goes to two files that are followed from outside. Signals go in
as lines on the guest's console. The exit status comes out through a file, because that of the kernel is always 0. A
shell for the user has a second console on the user's terminal; input from a pipe goes in as a file.

    JOB/            a folder under the temporary folder, removed afterwards
      init          the guest's first process: mounts, modules, vcan0, vcan1, then the command
      command       working folder, environment and arguments of the command
      stdin         of a shell, where it is no terminal
      xstate.so     from `xstate.c`, on processors that need it
      pid status    written by the guest: the command runs, the command has ended
      stdout stderr console
"""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import termios
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path

from canprobe.errors import BusError

PROGRAM = "linux.uml"
MODULES = Path("/usr/lib/uml/modules")
PACKAGE, COMPILER_PACKAGE = "user-mode-linux", "build-essential"
_WIDE_REGISTERS = "amx_tile"
"""Flag of processors whose extended registers do not fit into the guest's kernel, which then needs `xstate.c`."""
_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
_MEMORY_BYTES = 2 << 30
_MAX_BOOT_S = 60.0
_MAX_HALT_S = 5.0
_MAX_TERMINATION_S = 2.0
_HIDDEN_FOLDERS = ("/dev", "/proc", "/run", "/sys")

_INIT_SCRIPT = """\
#!/bin/sh
PATH={path}
export PATH
job={job}
end() {{
    sync
    echo o > /proc/sysrq-trigger
    sleep 60
}}
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t tmpfs -o mode=755 tmpfs /run
mkdir -p /dev/shm /dev/pts /run/lock
mount -t tmpfs -o mode=1777 tmpfs /dev/shm
mount -t devpts devpts /dev/pts
[ -e /dev/fd ] || ln -s /proc/self/fd /dev/fd
{realtime}
{terminal}
{python} -I -S {setup} {modules} || end
mknod /run/canprobe.console c 5 1
(
    while read -r name; do kill -s "$name" -- "-$(cat "$job/pid")"; done < /run/canprobe.console
    end
) 2> /dev/null &
setsid {session}sh "$job/command" {redirection}
echo $? > "$job/status"
end
"""

_COMMAND_SCRIPT = """\
echo $$ > {job}/pid
umask {umask:03o}
cd {folder} || exit 125
exec env -i {environment} sh -c 'exec "$@"' sh {command}
"""


class GuestError(BusError):
    """The guest could not be started, or ended before the command did.

    Attributes:
        started: whether the command was already running.
    """

    def __init__(self, message: str, started: bool) -> None:
        self.started = started
        super().__init__(message)


def missing_packages() -> list[str]:
    """Debian packages that a guest on this machine needs and that are missing."""
    installed = shutil.which(PROGRAM, path=_search_path()) is not None and any(
        MODULES.glob("*/kernel/drivers/net/can/vcan.ko")
    )
    missing = [] if installed else [PACKAGE]
    if _has_wide_registers() and shutil.which("cc") is None:
        missing.append(COMPILER_PACKAGE)
    return missing


def _has_wide_registers() -> bool:
    return _WIDE_REGISTERS in Path("/proc/cpuinfo").read_text().split()


def _search_path() -> str:
    return os.environ.get("PATH", "") + os.pathsep + _PATH


class GuestJob:
    """A command in a guest that boots when this is made; use as a context manager, which always ends the guest.

    Args:
        command: program and arguments.
        environment: whole environment of the command.
        realtime: whether to pin the guest to the last processor, its kernel under SCHED_FIFO, and keep that awake.
        shell: whether the command is a shell for the user, with the standard input, and the terminal, of this process.

    Raises:
        GuestError: the guest cannot be started from here.
    """

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], realtime: bool = False, shell: bool = False
    ) -> None:
        self._job = _job_folder()
        self._terminal = termios.tcgetattr(0) if shell and os.isatty(0) and os.isatty(1) else None
        self._has_stdin = shell and self._terminal is None
        self._spinner: subprocess.Popen[bytes] | None = None
        self._streams: list[tuple[int, int]] = []
        try:
            self._write_scripts(command, environment, realtime)
            self._streams = self._follow()
            self._process = self._boot(realtime)
        except BaseException:
            self._remove()
            raise
        self._boot_deadline = time.monotonic() + _MAX_BOOT_S

    def __enter__(self) -> GuestJob:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        self._remove()

    @property
    def started(self) -> bool:
        """Whether the command runs or has run."""
        return self._read("pid").endswith("\n")

    def poll(self) -> int | None:
        """Pass the output on; return the command's exit status once it has ended.

        Raises:
            GuestError: the guest died, or did not come up in a minute.
            BrokenPipeError: nobody reads the output any more.
        """
        ended = self._process.poll() is not None
        status = self._read("status")
        self._pass_output()
        if status.endswith("\n"):
            return int(status)
        if ended:
            raise self._lost("the guest ended before the command did" if self.started else "the guest did not boot")
        if not self.started and time.monotonic() > self._boot_deadline:
            raise self._lost(f"the guest did not boot in {_MAX_BOOT_S:.0f} s")
        return None

    def send_signal(self, number: int) -> None:
        """Send a signal to the command's process group; a guest that still boots is ended instead."""
        if not self.started:
            self.kill()
            return
        console = self._process.stdin
        assert console is not None
        with contextlib.suppress(BrokenPipeError):
            console.write(signal.Signals(number).name.removeprefix("SIG").encode() + b"\n")
            console.flush()

    def halt(self) -> None:
        """Give a guest whose command has ended the time to power off."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_MAX_HALT_S)

    def kill(self) -> None:
        """End the guest at once; nothing of it is left running."""
        if self._process.poll() is None:
            self._process.terminate()  # the kernel ends its own processes
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_MAX_TERMINATION_S)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        if self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.close()
        if self._terminal is not None:
            termios.tcsetattr(0, termios.TCSADRAIN, self._terminal)  # the guest has it raw
        if self._spinner is not None:
            self._spinner.kill()
            self._spinner.wait()

    def _read(self, name: str) -> str:
        try:
            return (self._job / name).read_text()
        except FileNotFoundError:
            return ""

    def _write_scripts(self, command: Sequence[str], environment: Mapping[str, str], realtime: bool) -> None:
        job = shlex.quote(str(self._job))
        stdin, output = "/dev/null", '>> "$job/stdout" ' + ("2>&1" if _same_file(1, 2) else '2>> "$job/stderr"')
        if self._has_stdin:
            stdin = '"$job/stdin"'
            with (self._job / "stdin").open("wb") as file:
                shutil.copyfileobj(sys.stdin.buffer, file)
        script = _INIT_SCRIPT.format(
            path=_PATH,
            job=job,
            modules=MODULES,
            python=shlex.quote(os.path.realpath(sys.executable)),
            setup=shlex.quote(str(Path(__file__).with_name("guest_setup.py"))),
            realtime="echo -1 > /proc/sys/kernel/sched_rt_runtime_us" if realtime else "",
            terminal="" if self._terminal is None else _second_console(),
            session="" if self._terminal is None else "--ctty ",
            redirection=f"< {stdin} {output}" if self._terminal is None else "<> /run/canprobe.tty >&0 2>&1",
        )
        init = self._job / "init"
        init.write_text(script)
        init.chmod(0o755)
        os.umask(umask := os.umask(0o077))
        text = _COMMAND_SCRIPT.format(
            job=job,
            umask=umask,
            folder=shlex.quote(_visible_folder()),
            environment=" ".join(shlex.quote(f"{name}={value}") for name, value in environment.items()),
            command=" ".join(map(shlex.quote, command)),
        )
        (self._job / "command").write_bytes(os.fsencode(text))

    def _follow(self) -> list[tuple[int, int]]:
        """Make the output files; return (file to read, our descriptor to write to) of each."""
        streams = []
        for name, target in (("stdout", 1), ("stderr", 2)):
            (self._job / name).touch()
            streams.append((os.open(self._job / name, os.O_RDONLY | os.O_CLOEXEC), target))
        return streams

    def _pass_output(self) -> None:
        for source, target in self._streams:
            while chunk := os.read(source, 1 << 20):
                _write_all(target, chunk)

    def _boot(self, realtime: bool) -> subprocess.Popen[bytes]:
        prefix, self._spinner = _pin() if realtime else (_favour(), None)
        if shutil.which("setpriv"):
            prefix = ["setpriv", "--pdeathsig", "TERM", *prefix]  # the guest ends with us, however we end
        folder, memory = memory_folder(("/dev/shm", tempfile.gettempdir(), "/tmp", "/var/tmp"))
        environment = {**os.environ, "TMPDIR": folder, "PATH": _search_path()}
        if _has_wide_registers():
            environment["LD_PRELOAD"] = _compile_xstate(self._job)
        arguments = [
            *("root=/dev/root", "rootfstype=hostfs", "rootflags=/", "rw", f"init={self._job}/init", "quiet"),
            *(f"mem={memory >> 20}M", f"umid=canprobe-{uuid.uuid4().hex[:12]}", f"uml_dir={self._job}/"),
            *("con=null", "con0=fd:0,fd:1", "ssl=null", "panic=-1"),
        ]
        ours = () if self._terminal is None else (os.dup(0), os.dup(1))
        if ours:
            arguments.append("con1=fd:{},fd:{}".format(*ours))
        with (self._job / "console").open("wb") as console:
            guest = subprocess.Popen(
                [*prefix, PROGRAM, *arguments],
                stdin=subprocess.PIPE,
                stdout=console,
                stderr=console,
                env=environment,
                start_new_session=True,
                pass_fds=ours,
            )
        for descriptor in ours:
            os.close(descriptor)
        _favour_session(guest.pid)
        return guest

    def _lost(self, what: str) -> GuestError:
        lines = (self._job / "console").read_bytes().decode(errors="replace").replace("\r", "").splitlines()
        panics = [line for line in lines if "Kernel panic" in line]
        telling = panics[:1] or [line for line in lines if line.strip()][-3:]
        return GuestError(": ".join([what, " | ".join(telling) or "its console is empty"]), self.started)

    def _remove(self) -> None:
        for source, _ in self._streams:
            os.close(source)
        self._streams = []
        shutil.rmtree(self._job, ignore_errors=True)


def _second_console() -> str:
    """Commands that make the second console of the guest, as large as our terminal."""
    size = os.get_terminal_size(1)
    node = "/run/canprobe.tty"
    return f"mknod {node} c 4 1\nstty -F {node} sane rows {size.lines} cols {size.columns}"


def _compile_xstate(folder: Path) -> str:
    """Compile the library that is loaded before those of the guest; see `xstate.c`."""
    library = folder / "xstate.so"
    source = Path(__file__).with_name("xstate.c")
    command = ["cc", "-shared", "-fPIC", "-O2", "-o", str(library), str(source), "-ldl"]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except subprocess.CalledProcessError as error:
        raise GuestError(f"the guest needs {source.name}, which {error.stderr.strip()}", False) from error
    return str(library)


def _job_folder() -> Path:
    """Make the job's folder where the guest sees it: it has a /run and a /dev of its own."""
    candidates = [tempfile.gettempdir(), "/tmp", "/var/tmp"]
    folder = next((f for f in candidates if not _hidden(f) and os.access(f, os.W_OK)), None)
    if folder is None:
        raise GuestError(f"no folder for the guest's files: none of {', '.join(candidates)} can be used", False)
    return Path(tempfile.mkdtemp(prefix="canprobe-vcan-", dir=folder)).resolve()


def _visible_folder() -> str:
    folder = os.getcwd()
    if _hidden(folder):
        raise GuestError(
            f"the working folder {folder} does not exist in the guest, which has its own {_HIDDEN_FOLDERS}", False
        )
    return folder


def _hidden(folder: str) -> bool:
    path = os.path.realpath(folder)
    return any(path == top or path.startswith(top + "/") for top in _HIDDEN_FOLDERS)


def memory_folder(folders: Sequence[str]) -> tuple[str, int]:
    """Return the first folder that can hold the guest's memory file, and the bytes for it.

    Args:
        folders: folders that are tried one after the other; one in RAM is quicker than one on a disk.

    Raises:
        GuestError: none of them can; the message has the reason of each.
    """
    problems = []
    for folder in dict.fromkeys(folders):
        try:
            state = os.statvfs(folder)
            tempfile.TemporaryFile(dir=folder).close()  # what access(2) says of root is not always true
        except OSError as error:
            problems.append(f"{folder} cannot be written ({error.strerror})")
            continue
        free = state.f_bavail * state.f_frsize
        if state.f_flag & os.ST_NOEXEC:
            problems.append(f"{folder} is mounted noexec")
        elif free < _MEMORY_BYTES // 4:
            problems.append(f"{folder} has {free >> 20} MiB free, of {_MEMORY_BYTES // 4 >> 20}")
        else:
            return folder, min(_MEMORY_BYTES, free)
    wanted = f"a folder that can be written, is not mounted noexec and has {_MEMORY_BYTES // 4 >> 20} MiB free"
    raise GuestError(f"no folder for the guest's memory: {'; '.join(problems)}; set TMPDIR to {wanted}", False)


def _on_last_processor() -> list[str]:
    """Words that keep a command on the last of several processors; empty where that is impossible."""
    processors = sorted(os.sched_getaffinity(0))
    if len(processors) < 2 or shutil.which("taskset") is None:
        return []
    return ["taskset", "-c", str(processors[-1])]


def _favour() -> list[str]:
    """Words before the guest that keep it on one processor and before others, as far as that is permitted.

    A guest that wanders between processors loses half its speed: the host faults its pages anew on each.
    """
    words = _on_last_processor()
    if os.geteuid() == 0 and shutil.which("nice") is not None:
        words += ["nice", "-n", "-20"]
    return words


def _favour_session(pid: int) -> None:
    """Let the session of `pid` go before others, where that is permitted.

    Kernels that group processes by session share processors between sessions; a nice value counts within one only.
    Source: sched(7), the autogroup feature.
    """
    with contextlib.suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text("-20")


def _pin() -> tuple[list[str], subprocess.Popen[bytes]]:
    """Return the prefix that pins the guest, and the idle-class process that keeps its processor awake.

    The guest's kernel gets SCHED_FIFO, and its processes do not inherit that: each is a process of this machine too,
    and one that only computes would not let the kernel of the guest on that processor any more.
    """
    pin = _on_last_processor()
    if not pin or shutil.which("chrt") is None:
        raise GuestError("--realtime needs two processors and util-linux (taskset, chrt)", False)
    favoured = [*pin, "chrt", "-R", "-f", "40"]
    if subprocess.run([*favoured, "true"], capture_output=True, check=False).returncode:
        raise GuestError("--realtime needs the right to use SCHED_FIFO (root, or CAP_SYS_NICE)", False)
    spinner = subprocess.Popen([*pin, "chrt", "-i", "0", sys.executable, "-c", "while True: pass"])
    return favoured, spinner


def _same_file(one: int, other: int) -> bool:
    try:
        return os.path.samestat(os.fstat(one), os.fstat(other))
    except OSError:
        return False


def _write_all(target: int, chunk: bytes) -> None:
    view = memoryview(chunk)
    while view:
        view = view[os.write(target, view) :]
