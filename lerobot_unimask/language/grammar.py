"""The grammar of the mask language: a text becomes a `Question`, or an error that shows where it does not.

A question is written in the paper's own notation, P(what is asked | what is shown): `a[t] | s[:t+1], a[:t]`. Nothing
of the text is ever evaluated.
"""

import re
from dataclasses import dataclass

MAX_TEXT = 1000  # characters

MAX_CONTEXT = 1024  # steps


class MaskError(ValueError):
    """A mask text that does not parse or asks for what does not exist; shows the text with a caret under the fault."""

    def __init__(self, message: str, text: str, position: int | None = None):
        line = re.sub(r"\s", " ", text)  # one line, so that the caret stands where it should
        caret = f"\n  {' ' * position}^" if position is not None else ""
        super().__init__(f"{message}\n  {line}{caret}")


@dataclass(frozen=True)
class Index:
    """One step: `3`, `-1`, or with `relative` an offset from t: `t+1`."""

    value: int
    relative: bool
    position: int  # of its first character in the text


@dataclass(frozen=True)
class Slice:
    """`start:stop:step`, each part optional."""

    start: Index | None
    stop: Index | None
    step: int


@dataclass(frozen=True)
class Term:
    """`factor[steps, ...]`."""

    factor: str
    steps: tuple[Index | Slice, ...]
    position: int
    of_episode: bool = False  # `s@150`, a step of the episode; of single tokens alone


@dataclass(frozen=True)
class Question:
    """The parsed form of `asked | shown`."""

    text: str
    asked: tuple[Term, ...]
    shown: tuple[Term, ...]

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.asked + self.shown

    @property
    def uses_t(self) -> bool:
        steps = [step for term in self.terms for step in term.steps]
        bounds = [b for s in steps for b in ((s.start, s.stop) if isinstance(s, Slice) else (s,)) if b is not None]
        return any(bound.relative for bound in bounds)


_TOKEN = re.compile(r"\s*(?:(?P<name>[A-Za-z_]\w*)|(?P<integer>\d+)|(?P<symbol>[\[\]:,+\-|@]))")


class _Parser:
    """Recursive descent over `terms | terms`; nothing of the text is ever evaluated."""

    def __init__(self, text: str, *, single: bool = False):
        self.text = text
        self.single = single  # a token to be given, not a question
        self.tokens: list[tuple[str, str, int]] = []  # (kind, text, position)
        end = len(text.rstrip())
        at = 0
        while at < end:
            match = _TOKEN.match(text, at)
            if match is None:
                at += len(text[at:]) - len(text[at:].lstrip())
                raise MaskError(
                    f"Unexpected character {text[at]!r}; a mask text looks like 'a[t] | s[:t+1], a[:t]'.", text, at
                )
            kind = str(match.lastgroup)
            self.tokens.append((kind, match[kind], match.start(kind)))
            at = match.end()
        self.tokens.append(("end", "", end))
        self.next = 0

    def fail(self, expected: str):
        kind, token, position = self.tokens[self.next]
        found = "the end of the text" if kind == "end" else repr(token)
        raise MaskError(f"Expected {expected}, found {found}.", self.text, position)

    def accept(self, *symbols: str) -> str | None:
        token = self.tokens[self.next][1]
        if token in symbols:
            self.next += 1
            return token
        return None

    def question(self) -> Question:
        asked = self.terms()
        shown: tuple[Term, ...] = ()
        if self.accept("|") and self.tokens[self.next][0] != "end":
            shown = self.terms()
        if self.tokens[self.next][0] != "end":
            self.fail("',' or the end of the text" if shown else "',' or '|'")
        return Question(self.text, asked, shown)

    def terms(self) -> tuple[Term, ...]:
        terms = [self.term()]
        while self.accept(","):
            terms.append(self.term())
        return tuple(terms)

    def term(self) -> Term:
        kind, name, position = self.tokens[self.next]
        if kind != "name":
            self.fail("a factor such as s or a")
        if name == "t":
            raise MaskError("'t' is the step, not a factor: write a[t] or s[t].", self.text, position)
        self.next += 1
        if self.single and self.accept("@"):
            index = Index(self.integer("+"), False, position)
            return Term(name, (index,), position, of_episode=True)
        if not self.accept("["):
            self.fail(f"'[' after {name}: factors are always indexed, as in {name}[0]")
        steps = [self.steps()]
        while self.accept(","):
            steps.append(self.steps())
        if not self.accept("]"):
            self.fail("',' or ']'")
        return Term(name, tuple(steps), position)

    def steps(self) -> Index | Slice:
        start = self.index()
        if not self.accept(":"):
            return start if start is not None else self.fail("a step: an integer, t, t+1, t-1 or a slice")
        stop = self.index()
        step = 1
        if self.accept(":"):
            position = self.tokens[self.next][2]
            index = self.index()
            if index is not None:
                if index.relative or index.value < 1:
                    raise MaskError("A slice's step is a positive integer.", self.text, position)
                step = index.value
        return Slice(start, stop, step)

    def index(self) -> Index | None:
        kind, token, position = self.tokens[self.next]
        if token == "t":
            self.next += 1
            sign = self.accept("+", "-")
            return Index(self.integer(sign) if sign else 0, True, position)
        if token == "-" or kind == "integer":
            return Index(self.integer(self.accept("-") or "+"), False, position)
        return None

    def integer(self, sign: str) -> int:
        kind, token, position = self.tokens[self.next]
        if kind != "integer":
            self.fail("an integer")
        if len(token) > 6:
            raise MaskError(f"A window has at most {MAX_CONTEXT} steps.", self.text, position)
        self.next += 1
        return -int(token) if sign == "-" else int(token)


def check_text(text: str) -> None:
    if not isinstance(text, str):
        raise TypeError(f"A mask is written as text, such as 'a[t] | s[:t+1], a[:t]'; got {type(text).__name__}.")
    if len(text) > MAX_TEXT:
        raise MaskError(f"A mask text has at most {MAX_TEXT} characters, this one has {len(text)}.", text[:60] + " ...")


def parse_question(text: str) -> Question:
    """
    Raises:
        MaskError: the text does not parse.
    """
    check_text(text)
    return _Parser(text).question()


def parse_terms(text: str) -> tuple[Term, ...]:
    """The terms of a text without a bar, as of a token that is given.

    Raises:
        MaskError: the text does not parse.
    """
    check_text(text)
    parser = _Parser(text, single=True)
    terms = parser.terms()
    if parser.tokens[parser.next][0] != "end":
        parser.fail("the end of the text")
    return terms
