"""The commands of `canprobe console`: a line of text each, whoever sends it, a person, a script or the screen."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from canprobe.cell.tasks.guided_arm import LIFETIME_S
from canprobe.cli.hand_session import HandSession
from canprobe.cli.move import share
from canprobe.errors import UsageError, did_you_mean

COMMANDS = {
    "yes": "answer a question; the first one lets the arm move in this session",
    "no": "answer a question",
    "jog N +": "move joint N by a step (or -), or on and on where the line is repeated within 150 ms;"
    " x, y, z, rx, ry, rz move the probe along an axis or about it",
    "step 1": "size of a step: 0.1, 1 or 10 deg or mm",
    "speed 5%": "share of the speed limits",
    "frame probe": "frame of the axes: base or probe",
    "move NAME": "show the way to a posture, or to 90,65,15,0,100,0, and ask",
    "teach NAME": "save the posture in which the arm stands",
    "home N": "home a joint; the drives are disabled meanwhile",
    "tare": "take what the array shows for zero; the drives are disabled meanwhile",
    "enable": "enable the drives",
    "disable": "disable the drives",
    "reset": "after a stop or a fault: ask whether the arm may move again",
    "stop": "quick stop",
    "where": "print joints and force",
    "renew": "let a motion go on for 150 ms; so does an empty line, which also goes on with one that has paused",
    "help": "print this list",
    "quit": "end",
}
"""What the commands do, by how they are typed."""
STEPS = ("0.1", "1", "10")
_FORMS = {form.split()[0]: form for form in COMMANDS}


class Words:
    """Takes lines, and has a session do what they say.

    Args:
        session: the session.
        typed: returns what was typed since the last call, and whether there may be more.
        show: called with each answer.
    """

    def __init__(
        self, session: HandSession, typed: Callable[[], tuple[bytes, bool]], show: Callable[[str], None]
    ) -> None:
        self._session, self._typed, self._show = session, typed, show
        self._text, self._line, self._line_ns = b"", "", 0
        questions, errands = session.questions, session.errands
        self._actions: dict[str, Callable[..., object]] = {
            **{name: partial(self._show, "nothing was asked") for name in ("yes", "no")},
            **{"jog": self._jog, "step": self._step, "speed": self._speed, "frame": self._frame},
            **{"move": session.motions.move, "teach": errands.teach, "home": self._home, "tare": errands.tare},
            **{"enable": questions.enable, "disable": session.disable, "reset": questions.reset, "stop": session.stop},
            **{"where": session.where, "help": self._help, "quit": session.end},
        }

    def take(self) -> None:
        """Do the lines that have come; at their end the session ends."""
        text, is_open = self._typed()
        *lines, self._text = (self._text + text).split(b"\n")
        for line in lines:
            self._session.attempt(partial(self._do, line.decode(errors="replace").strip()))
        if not is_open and not self._session.ended:
            self._show("the input has ended")
            self._session.end()

    def _do(self, line: str) -> None:
        questions, motions = self._session.questions, self._session.motions
        if line in ("", "renew"):
            return motions.renew(goes_on=not line)
        name, *given = line.split()
        asked, questions.asked = questions.asked, None
        motions.forget_pause()
        repeated = line == self._line and self._now_ns - self._line_ns <= 1e9 * LIFETIME_S
        self._line, self._line_ns = line, self._now_ns
        if (form := _FORMS.get(name)) is None:
            raise UsageError(f"{line}: unknown command{did_you_mean(name, _FORMS)}; `help` lists the commands")
        if len(given) != len(form.split()) - 1:
            raise UsageError(f"{line}: expected `{form}`; `help` lists the commands")
        if name == "yes" and asked is not None:
            asked[1]()
        elif name == "no" and asked is not None:
            self._show("nothing is done")
        else:
            self._actions[name](*given, **({"repeated": repeated} if name == "jog" else {}))

    @property
    def _now_ns(self) -> int:
        return self._session.view.seen.t_ns

    def _jog(self, which: str, sign: str, *, repeated: bool) -> None:
        if sign not in ("+", "-"):
            raise UsageError(f"jog {which} {sign}: expected + or -")
        self._session.motions.jog(which, 1 if sign == "+" else -1, repeated=repeated)

    def _step(self, size: str) -> None:
        if size not in STEPS:
            raise UsageError(f"step {size}: expected one of {', '.join(STEPS)}")
        self._session.motions.step = float(size)

    def _speed(self, text: str) -> None:
        self._session.motions.speed = share(text)

    def _frame(self, frame: str) -> None:
        if frame not in ("base", "probe"):
            raise UsageError(f"frame {frame}: expected base or probe")
        self._session.motions.in_probe_frame = frame == "probe"

    def _home(self, number: str) -> None:
        if not number.isdecimal():
            raise UsageError(f"home {number}: expected the number of a joint")
        self._session.errands.home(int(number))

    def _help(self) -> None:
        self._show("\n".join(f"{form:<12} {what}" for form, what in COMMANDS.items()))
