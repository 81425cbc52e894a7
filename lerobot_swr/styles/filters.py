"""The filter language: which demonstrations' styles may be drawn, as an expression over their table.

    70 <= length <= 80 and behavior == '6410'

Comparisons (also chained), ``and`` / ``or`` / ``not``, ``in`` / ``not in``, parentheses, numbers, strings,
``True`` / ``False``, and lists or tuples of constants mean what they mean in Python. Nothing else exists: no
calls, attributes, subscripts or arithmetic. Python's parser reads the text, the walker below turns the tree
into functions of a row; nothing is ever evaluated as Python.
"""

import ast
import io
import keyword
import operator
import tokenize
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

Value = float | str | bool
Row = Mapping[str, Value]
Kind = Literal["number", "text", "truth"]

MAX_CHARACTERS = 2000
MAX_DEPTH = 30
MAX_MAGNITUDE = 1e15

_OPERATORS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.In: lambda item, container: item in container,
    ast.NotIn: lambda item, container: item not in container,
}
# Python's keywords that no expression contains: the style table has a column called "return".
_STATEMENT_WORDS = frozenset(keyword.kwlist) - {
    *("and", "or", "not", "in", "is", "True", "False", "None"),
    *("if", "else", "for", "lambda", "await", "async", "yield"),
}
_MARK = "\u01c3"  # a letter that begins no name
_ORDERING = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)


class FilterError(ValueError):
    """A filter that cannot be used; the message names the filter, what is wrong and what is known."""


def select(text: str, columns: Mapping[str, Sequence[Value]]) -> np.ndarray:
    """Which rows of a table a filter keeps.

    Args:
        text: The filter.
        columns: Name to N values, all numbers, all strings or all booleans.

    Returns:
        (N,) bool.

    Raises:
        FilterError: If the text is no filter, names an unknown column or compares what does not compare.
    """
    kinds = {name: column_kind(values) for name, values in columns.items()}
    kind, keeps = _Compiler(text, kinds, columns).compile(parse_filter(text))
    if kind != "truth":
        raise FilterError(f"style_filter={text!r}: this is a {kind}, not a condition; compare it, e.g. x > 1")
    names = list(columns)
    rows = (dict(zip(names, row, strict=True)) for row in zip(*columns.values(), strict=True))
    return np.array([keeps(row) for row in rows], dtype=bool)


def parse_filter(text: str) -> ast.expr:
    """The syntax tree of a filter, without a look at any table.

    Raises:
        FilterError: If the text is too long, too deeply nested or no expression.
    """
    if len(text) > MAX_CHARACTERS:
        raise FilterError(f"style_filter={text[:40]!r}...: {len(text)} characters; allowed: {MAX_CHARACTERS}")
    try:
        tree = ast.parse(_with_plain_names(text.strip()), mode="eval").body
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else "it cannot be parsed"
        raise FilterError(
            f"style_filter={text!r}: {reason}; expected e.g. \"70 <= length <= 80 and behavior == '6410'\""
        ) from error
    level = [tree]
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            node.id = node.id.removeprefix(_MARK)
    for _ in range(MAX_DEPTH):
        level = [child for node in level for child in ast.iter_child_nodes(node)]  # type: ignore[misc]
        if not level:
            return tree
    raise FilterError(f"style_filter={text!r}: nested deeper than {MAX_DEPTH} levels; simplify it")


def names_in(text: str) -> set[str]:
    """The columns that a filter looks at.

    Raises:
        FilterError: If the text is no filter.
    """
    return {node.id for node in ast.walk(parse_filter(text)) if isinstance(node, ast.Name)}


def _with_plain_names(text: str) -> str:
    """The text with a mark before words that begin a statement in Python, such as ``return``: names here."""
    try:
        tokens = list(tokenize.generate_tokens(io.StringIO(text).readline))
    except tokenize.TokenError:
        return text  # the parser says what is wrong
    words = [token for token in tokens if token.type == tokenize.NAME and token.string in _STATEMENT_WORDS]
    lines = text.splitlines(keepends=True)
    for token in reversed(words):
        row, column = token.start
        lines[row - 1] = f"{lines[row - 1][:column]}{_MARK}{lines[row - 1][column:]}"
    return "".join(lines)


def column_kind(values: Sequence[Value]) -> Kind:
    """Whether a column holds numbers, text or truth values."""
    first = values[0] if len(values) else 0.0
    if isinstance(first, bool):
        return "truth"
    return "text" if isinstance(first, str) else "number"


def describe_columns(columns: Mapping[str, Sequence[Value]]) -> str:
    """The columns and their ranges, as error messages list them."""
    return "; ".join(f"{name} {describe_column(values)}" for name, values in columns.items())


def describe_column(values: Sequence[Value]) -> str:
    """Range of a column of numbers, or the values of a column of text."""
    if column_kind(values) == "number":
        return f"{min(values):g} to {max(values):g}"  # type: ignore[type-var, str-format]
    distinct = sorted(set(values), key=str)
    shown = ", ".join(repr(value) for value in distinct[:12])
    return shown + (f" and {len(distinct) - 12} more" if len(distinct) > 12 else "")


Compiled = tuple[Kind, Callable[[Row], Any]]


class _Compiler:
    """Turns a filter's syntax tree into a function of a row, checking kinds on the way."""

    def __init__(self, text: str, kinds: Mapping[str, Kind], columns: Mapping[str, Sequence[Value]]):
        self.text, self.kinds, self.columns = text, kinds, columns

    def compile(self, node: ast.expr) -> Compiled:
        """Kind and value of an expression."""
        match node:
            case ast.BoolOp():
                return "truth", self._junction(node)
            case ast.UnaryOp(op=ast.Not()):
                operand = self._condition(node.operand)
                return "truth", lambda row: not operand(row)
            case ast.Compare():
                return "truth", self._comparison(node)
            case ast.Name():
                return self._column(node.id)
            case ast.Constant() | ast.UnaryOp():
                value = self._constant(node)
                return column_kind([value]), lambda row: value
            case ast.List() | ast.Tuple():
                raise self._error("a list can only stand to the right of 'in'")
        raise self._error(
            f"{_NAMES.get(type(node), type(node).__name__)} not allowed; a filter has comparisons, "
            "and/or/not, in, names, numbers and strings"
        )

    def _junction(self, node: ast.BoolOp) -> Callable[[Row], bool]:
        parts = [self._condition(value) for value in node.values]
        if isinstance(node.op, ast.And):
            return lambda row: all(part(row) for part in parts)
        return lambda row: any(part(row) for part in parts)

    def _condition(self, node: ast.expr) -> Callable[[Row], bool]:
        kind, value = self.compile(node)
        if kind != "truth":
            raise self._error(f"{ast.unparse(node)} is a {kind}, not a condition; compare it, e.g. with ==")
        return value

    def _comparison(self, node: ast.Compare) -> Callable[[Row], bool]:
        operands = [node.left, *node.comparators]
        links = []
        for left, op, right in zip(operands, node.ops, operands[1:], strict=False):
            if type(op) not in _OPERATORS:
                raise self._error("'is' is not allowed; write ==")
            links.append(self._link(left, op, right))
        return lambda row: all(link(row) for link in links)

    def _link(self, left: ast.expr, op: ast.cmpop, right: ast.expr) -> Callable[[Row], bool]:
        compare, (kind, value) = _OPERATORS[type(op)], self.compile(left)
        source = f"{ast.unparse(left)} and {ast.unparse(right)}"
        if isinstance(op, ast.In | ast.NotIn) and isinstance(right, ast.List | ast.Tuple):
            members = [self._constant(element) for element in right.elts]
            strangers = [member for member in members if column_kind([member]) != kind]
            if strangers:
                raise self._error(f"{ast.unparse(left)} is a {kind}, {strangers[0]!r} in its list is not")
            return lambda row: compare(value(row), members)
        other_kind, other = self.compile(right)
        if isinstance(op, ast.In | ast.NotIn) and (kind, other_kind) != ("text", "text"):
            raise self._error(f"'in' needs a list, or text in text, not {source} ({kind}, {other_kind})")
        if kind != other_kind:
            raise self._error(
                f"{source} do not compare: {kind} and {other_kind}{self._quote_hint(left, right)}"
            )
        if kind == "truth" and isinstance(op, _ORDERING):
            raise self._error(f"{source} are truth values and have no order; use ==")
        return lambda row: compare(value(row), other(row))

    def _quote_hint(self, left: ast.expr, right: ast.expr) -> str:
        for name, constant in ((left, right), (right, left)):
            if isinstance(name, ast.Name) and isinstance(constant, ast.Constant) and name.id in self.kinds:
                literal = str(constant.value)
                wanted = repr(literal) if self.kinds[name.id] == "text" else literal
                return f"; {name.id} holds {self.kinds[name.id]}, write {name.id} == {wanted}"
        return ""

    def _column(self, name: str) -> Compiled:
        if name not in self.kinds:
            raise self._error(f"unknown name {name!r}; known: {describe_columns(self.columns)}")
        return self.kinds[name], lambda row: row[name]

    def _constant(self, node: ast.expr) -> Value:
        sign = 1
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            sign, node = (-1 if isinstance(node.op, ast.USub) else 1), node.operand
            if isinstance(node, ast.Constant) and isinstance(node.value, bool | str):
                raise self._error(f"a sign before {node.value!r}")
        if not isinstance(node, ast.Constant):
            raise self._error(f"{ast.unparse(node)} is not a number or a string")
        value = node.value
        if isinstance(value, bool | str):
            return value
        if not isinstance(value, int | float):
            raise self._error(f"{ast.unparse(node)} is not a number or a string")
        if abs(value) > MAX_MAGNITUDE:
            raise self._error(f"a number beyond {MAX_MAGNITUDE:g}")
        return sign * value

    def _error(self, reason: str) -> FilterError:
        return FilterError(f"style_filter={self.text!r}: {reason}")


_NAMES: dict[type[ast.AST], str] = {
    ast.Call: "a function call is",
    ast.Attribute: "an attribute (x.y) is",
    ast.Subscript: "indexing (x[y]) is",
    ast.BinOp: "arithmetic is",
    ast.Lambda: "a lambda is",
    ast.IfExp: "if/else is",
    ast.NamedExpr: "an assignment is",
    ast.JoinedStr: "an f-string is",
    ast.Dict: "a dictionary is",
    ast.Set: "a set is",
    ast.ListComp: "a comprehension is",
    ast.SetComp: "a comprehension is",
    ast.DictComp: "a comprehension is",
    ast.GeneratorExp: "a comprehension is",
    ast.Starred: "unpacking (*x) is",
    ast.Await: "await is",
    ast.Yield: "yield is",
    ast.YieldFrom: "yield is",
}
