"""Straight-line code: arithmetic carried out once on symbols, written down as one Python function and compiled.

A recursion over the links of an arm in small arrays pays for every call; the same recursion on plain floats pays for
loops, lists and products with 0 and 1. ``compiled`` runs it once on symbols: zeros and ones vanish, what is computed
twice is computed once, what nobody needs is dropped, and the rest is a list of assignments to local variables. The
source of the function is its ``source`` attribute.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

Value = Any
"""A ``Symbol`` or a float: what the arithmetic to be compiled works on."""
Numbers = Sequence[float]
_LONGEST = 400
"""Characters of an expression that may still stand inside another: parsers nest to a limited depth."""


class Symbol:
    """A number that is not known yet.

    Args:
        tape: where what is done with it is noted.
        form: its text, with ``{}`` for each part.
        parts: symbols and floats that it is made of.
    """

    __slots__ = ("form", "parts", "tape")

    def __init__(self, tape: Tape, form: str, parts: tuple[Value, ...]) -> None:
        self.tape, self.form, self.parts = tape, form, parts

    def __neg__(self) -> Value:
        return self.parts[0] if self.form == "-{}" else self.tape.note("-{}", self)

    def __add__(self, other: Value) -> Value:
        if isinstance(other, Symbol):
            return self - other.parts[0] if other.form == "-{}" else self.tape.note("({} + {})", self, other)
        return self if other == 0.0 else self.tape.note("({} + {})", self, other)

    def __radd__(self, other: float) -> Value:
        return self + other

    def __sub__(self, other: Value) -> Value:
        if isinstance(other, Symbol):
            return self + other.parts[0] if other.form == "-{}" else self.tape.note("({} - {})", self, other)
        return self if other == 0.0 else self.tape.note("({} - {})", self, other)

    def __rsub__(self, other: float) -> Value:
        return -self + other

    def __mul__(self, other: Value) -> Value:
        if self.form == "-{}":
            return -(self.parts[0] * other)
        if isinstance(other, Symbol):
            return -(self * other.parts[0]) if other.form == "-{}" else self.tape.note("({} * {})", self, other)
        if other in (0.0, 1.0, -1.0):
            return 0.0 if other == 0.0 else self if other == 1.0 else -self
        return self.tape.note("({} * {})", self, other)

    def __rmul__(self, other: float) -> Value:
        return self * other

    def __truediv__(self, other: Value) -> Value:
        return self.tape.note("({} / {})", self, other)

    def __rtruediv__(self, other: float) -> Value:
        return self.tape.note("({} / {})", other, self)


class Tape:
    """All that is done with the symbols of one function, each thing once."""

    def __init__(self) -> None:
        self.noted: dict[tuple[str, tuple[int | float, ...]], Symbol] = {}

    def note(self, form: str, *parts: Value) -> Symbol:
        """The symbol of an operation.

        Args:
            form: text of the operation, with ``{}`` for each part.
            *parts: symbols and floats.
        """
        key = form, tuple(id(p) if isinstance(p, Symbol) else p for p in parts)
        if key not in self.noted:
            self.noted[key] = Symbol(self, form, parts)
        return self.noted[key]

    def inputs(self, name: str, known: Numbers | int) -> list[Value]:
        """Symbols of one argument of the function, a sequence.

        Args:
            name: of the argument.
            known: its length; or values, of which zeros are taken for granted.
        """
        values = [1.0] * known if isinstance(known, int) else known
        return [self.note(f"{name}{i}") if value != 0.0 else 0.0 for i, value in enumerate(values)]


def call(function: str, *values: Value) -> Value:
    """A function of values, the first of them a symbol.

    Args:
        function: its name among the functions given to ``compiled``.
        *values: symbols and floats.
    """
    return values[0].tape.note(f"{function}({', '.join(['{}'] * len(values))})", *values)


def where(condition: str, a: Value, b: Value, yes: Value, no: Value) -> Value:
    """One of two values.

    Args:
        condition: a comparison, as ``>`` or ``==``.
        a: a symbol, left of it.
        b: right of it.
        yes: where it holds.
        no: where it does not.
    """
    return a.tape.note(f"({{}} if {{}} {condition} {{}} else {{}})", yes, a, b, no)


def compiled(
    name: str, work: Callable[..., Sequence[Value]], functions: Mapping[str, Any], /, **arguments: Numbers | int
) -> Callable[..., tuple[float, ...]]:
    """Compile arithmetic.

    Args:
        name: of the function.
        work: called with a list of values for each argument by its name; returns what is wanted, floats or symbols.
        functions: that the noted forms call.
        **arguments: lengths of the arguments; or values, of which zeros are taken for granted.

    Returns:
        Function of as many sequences of floats, by position; returns floats in the order of ``work``.
    """
    tape = Tape()
    results = work(**{key: tape.inputs(key, known) for key, known in arguments.items()})
    source = _source(name, {k: len(v) if not isinstance(v, int) else v for k, v in arguments.items()}, results)
    space = dict(functions)
    exec(compile(source, f"<straight line: {name}>", "exec"), space)  # our own text, of symbols and numbers only
    function: Callable[..., tuple[float, ...]] = space[name]
    function.source = source  # type: ignore[attr-defined]
    return function


def matrix_product(matrix: Sequence[Numbers]) -> Callable[[Numbers], tuple[float, ...]]:
    """Function x -> A x on plain floats.

    Args:
        matrix: A, rows of equal length, of at least one entry that is not zero each.
    """

    def work(x: list[Value]) -> list[Value]:
        return [sum((value * share for value, share in zip(x, row, strict=True) if share), 0.0) for row in matrix]

    return compiled("matrix_product", work, {}, x=len(matrix[0]))


def _source(name: str, arguments: Mapping[str, int], results: Sequence[Value]) -> str:
    """The function's text: a value that is used once stands where it is used, the others get names."""
    order = _needed(results)
    uses = dict.fromkeys(order, 0)
    for symbol in [*(p for s in order for p in s.parts), *results]:
        if isinstance(symbol, Symbol):
            uses[symbol] += 1
    text: dict[Symbol, str] = {}
    lines = [f"def {name}({', '.join(arguments)}):"]
    lines += [f"    {', '.join(f'{key}{i}' for i in range(n))}, = {key}" for key, n in arguments.items()]

    def say(value: Value) -> str:
        return text[value] if isinstance(value, Symbol) else repr(float(value))

    for symbol in order:
        text[symbol] = symbol.form.format(*map(say, symbol.parts))
        if symbol.parts and (uses[symbol] > 1 or len(text[symbol]) > _LONGEST):
            lines.append(f"    _{len(lines)} = {text[symbol]}")
            text[symbol] = f"_{len(lines) - 1}"
    return "\n".join([*lines, f"    return ({', '.join(map(say, results))},)", ""])


def _needed(results: Sequence[Value]) -> list[Symbol]:
    """Symbols that the results rest on, each after its parts."""
    found: dict[Symbol, None] = {}
    open_: list[tuple[Value, bool]] = [(r, False) for r in reversed(results)]
    while open_:
        symbol, ready = open_.pop()
        if not isinstance(symbol, Symbol) or symbol in found:
            continue
        if ready:
            found[symbol] = None
        else:
            open_ += [(symbol, True), *((p, False) for p in symbol.parts)]
    return list(found)
