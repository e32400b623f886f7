"""Small wrong changes to a source, one at a time: what the tests are asked to notice.

A mutant differs in one place: a comparison is turned round, a condition negated, a constant changed, a statement left
out, ... (DeMillo, Lipton and Sayward, "Hints on test data selection", 1978). Text is replaced, not regenerated: lines
keep their numbers, and a mutant reads like the source it was made from.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

TURNED: dict[type[ast.cmpop], str] = {
    ast.Lt: ">=", ast.LtE: ">", ast.Gt: "<=", ast.GtE: "<", ast.Eq: "!=", ast.NotEq: "==",
    ast.Is: "is not", ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in",
}  # fmt: skip
WRITTEN: dict[type[ast.cmpop], str] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
    ast.Is: "is", ast.IsNot: "is not", ast.In: "in", ast.NotIn: "not in",
}  # fmt: skip
SWAPPED: dict[type[ast.operator], tuple[str, str]] = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"),
}  # fmt: skip
OPPOSITE = {
    "minimum": "maximum", "maximum": "minimum", "min": "max", "max": "min", "any": "all", "all": "any",
    "argmin": "argmax", "argmax": "argmin", "floor": "ceil", "ceil": "floor",
}  # fmt: skip
WORDS = {"__repr__", "__str__"}  # functions that only word something
SHOWN = 90  # characters of the original in a mutant's name


@dataclass(frozen=True)
class Mutation:
    """One change.

    Attributes:
        begin, end: bytes of the source that are replaced.
        line: where it begins, from 1.
        function: qualified name of the function around it, "" at the level of the module.
        name: unique within a source, and the same however far the code around it moves.
        replacement: what stands there instead.
        compiled: whether the function around it runs under Numba, where no line can be seen to run.
    """

    begin: int
    end: int
    line: int
    function: str
    name: str
    replacement: str
    compiled: bool

    def applied(self, source: str) -> str:
        """The source with this change."""
        data = source.encode()
        return (data[: self.begin] + self.replacement.encode() + data[self.end :]).decode()


def mutations(source: str) -> list[Mutation]:
    """Every change of a source, in the order of its text."""
    found: list[Mutation] = []
    seen: dict[str, int] = {}
    finder = _Finder(source)
    for node, replacement, function, compiled in sorted(
        finder.changes(), key=lambda change: (finder.span(change[0]), change[1])
    ):
        begin, end = finder.span(node)
        name = f"{function or 'module'}: {_short(finder.text(node))} -> {_short(replacement)}"
        seen[name] = seen.get(name, 0) + 1
        if seen[name] > 1:
            name += f" ({seen[name]})"
        found.append(Mutation(begin, end, node.lineno, function, name, replacement, compiled))
    return found


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= SHOWN else text[: SHOWN - 3] + "..."


Change = tuple[ast.expr | ast.stmt, str, str, bool]


class _Finder:
    """Walks a source and lists what can be changed."""

    def __init__(self, source: str) -> None:
        self.data = source.encode()
        self.tree = ast.parse(source)
        self.starts = [0]
        for row in self.data.splitlines(keepends=True):
            self.starts.append(self.starts[-1] + len(row))

    def span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None and node.end_col_offset is not None
        return self.starts[node.lineno - 1] + node.col_offset, self.starts[node.end_lineno - 1] + node.end_col_offset

    def text(self, node: ast.expr | ast.stmt) -> str:
        begin, end = self.span(node)
        return self.data[begin:end].decode()

    def part(self, node: ast.expr) -> str:
        """The text of an operand, which keeps together in any place."""
        whole = isinstance(node, ast.Name | ast.Attribute | ast.Call | ast.Subscript | ast.Constant)
        return self.text(node) if whole else f"({self.text(node)})"

    def changes(self) -> Iterator[Change]:
        yield from self._body(self.tree.body, (), False)

    def _body(self, statements: list[ast.stmt], path: tuple[str, ...], compiled: bool) -> Iterator[Change]:
        for statement in statements:
            yield from self._statement(statement, path, compiled)

    def _statement(self, node: ast.stmt, path: tuple[str, ...], compiled: bool) -> Iterator[Change]:
        where = ".".join(path)
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            if node.name in WORDS:
                return
            marks = [ast.unparse(mark) for mark in node.decorator_list]
            inner = compiled or any(mark in ("compiled", "inlined", "linked") or "jit" in mark for mark in marks)
            result = ast.unparse(node.returns) if isinstance(node, ast.FunctionDef) and node.returns else ""
            yield from self._body(node.body, (*path, node.name), inner)
            if isinstance(node, ast.FunctionDef):
                yield from self._returns(node, result, ".".join((*path, node.name)), inner)
                for default in [*node.args.defaults, *node.args.kw_defaults]:
                    if default is not None:
                        yield from self._expression(default, where, compiled)
            return
        if isinstance(node, ast.Import | ast.ImportFrom | ast.Assert | ast.Raise):
            return
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        if path and self._omissible(node):
            yield node, "pass", where, compiled
        if isinstance(node, ast.If | ast.While):
            yield from self._negated(node.test, where, compiled)
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.stmt):
                yield from self._statement(child, path, compiled)
            elif isinstance(child, ast.ExceptHandler):
                yield from self._body(child.body, path, compiled)
            elif isinstance(child, ast.expr) and not (isinstance(node, ast.AnnAssign) and child is node.annotation):
                yield from self._expression(child, where, compiled)

    @staticmethod
    def _omissible(node: ast.stmt) -> bool:
        """True if the code without a statement is still meaningful: its targets exist elsewhere already."""
        if isinstance(node, ast.Assign):
            return all(isinstance(target, ast.Attribute | ast.Subscript) for target in node.targets)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            return "log" not in ast.unparse(node.value.func).split(".")[0]
        return isinstance(node, ast.AugAssign | ast.Continue | ast.Break)

    def _returns(self, node: ast.FunctionDef, result: str, where: str, compiled: bool) -> Iterator[Change]:
        """Answers: the opposite one, or none where there may be none."""
        for inner in _own(node):
            if isinstance(inner, ast.Return) and inner.value is not None:
                if result == "bool" and not isinstance(inner.value, ast.Constant | ast.Compare):
                    yield inner.value, f"not ({self.text(inner.value)})", where, compiled
                elif result.endswith("| None") and not _is_none(inner.value):
                    yield inner.value, "None", where, compiled

    def _negated(self, test: ast.expr, where: str, compiled: bool) -> Iterator[Change]:
        """A condition that is no comparison; those are turned round as such."""
        if isinstance(test, ast.Name | ast.Attribute | ast.Call | ast.Subscript | ast.NamedExpr):
            yield test, f"(not ({self.text(test)}))", where, compiled

    def _expression(self, node: ast.expr, where: str, compiled: bool) -> Iterator[Change]:
        if isinstance(node, ast.JoinedStr):  # words
            return
        for replacement in self._replacements(node):
            yield node, replacement, where, compiled
        if isinstance(node, ast.IfExp):
            yield from self._negated(node.test, where, compiled)
        if isinstance(node, ast.BoolOp):
            for value in node.values:
                yield from self._negated(value, where, compiled)
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.expr):
                if isinstance(node, ast.Subscript) and child is node.slice and not _compares(child):
                    continue  # a wrong place is seen by its reader
                yield from self._expression(child, where, compiled)
            elif isinstance(child, ast.keyword):
                yield from self._expression(child.value, where, compiled)
            elif isinstance(child, ast.comprehension):
                yield from self._expression(child.iter, where, compiled)
                for test in child.ifs:
                    yield from self._negated(test, where, compiled)
                    yield from self._expression(test, where, compiled)

    def _replacements(self, node: ast.expr) -> Iterator[str]:
        if isinstance(node, ast.Compare):
            for place in range(len(node.ops)):
                text = self.part(node.left)
                for k, (op, right) in enumerate(zip(node.ops, node.comparators, strict=True)):
                    kind = type(op)
                    text += f" {TURNED[kind] if k == place else WRITTEN[kind]} {self.text(right)}"
                yield text
        elif isinstance(node, ast.BoolOp):
            between = " or " if isinstance(node.op, ast.And) else " and "
            yield "(" + between.join(self.part(value) for value in node.values) + ")"
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.Invert | ast.USub):
            if not (isinstance(node.op, ast.USub) and isinstance(node.operand, ast.Constant)):
                yield f"({self.text(node.operand)})"
        elif isinstance(node, ast.BinOp) and type(node.op) in SWAPPED and not _words(node):
            yield f"({self.part(node.left)} {SWAPPED[type(node.op)][1]} {self.part(node.right)})"
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
            called = self.text(node.func)
            last = called.rpartition(".")[2]
            if last in OPPOSITE:
                yield called[: len(called) - len(last)] + OPPOSITE[last] + self.text(node)[len(called) :]
        elif isinstance(node, ast.Constant):
            if isinstance(node.value, bool):
                yield repr(not node.value)
            elif isinstance(node.value, int):
                yield repr(node.value + 1)
            elif isinstance(node.value, float):
                yield repr(2.0 * node.value if node.value else 1.0)


def _own(function: ast.FunctionDef) -> Iterator[ast.AST]:
    """Nodes of a function without those of functions in it."""
    rest: list[ast.AST] = list(function.body)
    while rest:
        node = rest.pop()
        yield node
        if not isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Lambda):
            rest.extend(ast.iter_child_nodes(node))


def _words(node: ast.BinOp) -> bool:
    """True for an operation on text or types."""
    return any(
        isinstance(part, ast.JoinedStr)
        or (isinstance(part, ast.Constant) and (part.value is None or isinstance(part.value, str)))
        for part in ast.walk(node)
    )


def _compares(node: ast.expr) -> bool:
    return any(isinstance(part, ast.Compare | ast.BoolOp | ast.Invert) for part in ast.walk(node))


def _is_none(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is None
