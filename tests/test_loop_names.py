"""No loop takes over a name that stands for something else after it: reaching definitions of functions."""

import ast

import pytest
from sources import ROOT

FOLDERS = ["quad_envs", "controllers", "baselines", "benchmarks", "examples", "tests"]
FILES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
SCOPES = (*FUNCTIONS, ast.Lambda, ast.ClassDef, ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


class Flow:
    """Which bindings of each name reach each use of it, statement by statement, loops to a fixed point."""

    def __init__(self, function):
        self.found = set()
        self.jumps = []  # of each loop around: states at its breaks, and at its continues
        arguments = function.args
        every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
        self.block(function.body, {argument.arg: {argument} for argument in every}, ())

    def block(self, statements, state, loops):
        for statement in statements:
            state = self.statement(statement, state, loops)
        return state

    def statement(self, node, state, loops):
        """The state after a statement; None where nothing comes after it."""
        if state is None:
            return None
        if isinstance(node, ast.For | ast.While):
            return self.loop(node, state, loops)
        if isinstance(node, ast.If):
            self.uses(node.test, state, loops)
            return join(self.block(node.body, state, loops), self.block(node.orelse, state, loops))
        if isinstance(node, ast.Try):
            body = self.block(node.body, state, loops)
            ends = [self.block(node.orelse, body, loops) if body is not None else None]
            ends += [self.block(h.body, join(state, body), loops) for h in node.handlers]
            after = join(*ends)
            return self.block(node.finalbody, after, loops) if after is not None else None
        if isinstance(node, ast.With):
            for item in node.items:
                self.uses(item.context_expr, state, loops)
                state = bind(item.optional_vars, state)
            return self.block(node.body, state, loops)
        if isinstance(node, ast.Match):
            return join(state, *(self.block(case.body, state, loops) for case in node.cases))
        if isinstance(node, ast.Break | ast.Continue):
            self.jumps[-1][isinstance(node, ast.Continue)].append(state)
            return None
        self.uses(node, state, loops)
        if isinstance(node, ast.Return | ast.Raise):
            return None
        return bind(node, state)

    def loop(self, node, state, loops):
        before, entered = None, state
        while entered != before:
            before = entered
            self.uses(node.iter if isinstance(node, ast.For) else node.test, before, loops)
            inside = bind(node.target, before, node) if isinstance(node, ast.For) else before
            self.jumps.append(([], []))
            end = self.block(node.body, inside, (*loops, node))
            breaks, continues = self.jumps.pop()
            entered = join(before, end, *continues)
        return join(self.block(node.orelse, entered, loops), *breaks)

    def uses(self, node, state, loops):
        for name in names(node):
            if isinstance(name.ctx, ast.Load) or isinstance(node, ast.AugAssign):
                reach = state.get(name.id, set())
                left = {b for b in reach if isinstance(b, ast.For) and b not in loops}
                if left and len(reach) > 1:
                    self.found.add((name.id, min(loop.lineno for loop in left), name.lineno))


def names(node):
    """Names of this scope in an expression or a simple statement."""
    if isinstance(node, ast.Name):
        yield node
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, SCOPES):
            yield from names(child)


def bind(node, state, source=None):
    """The state after the names that `node` stores are bound by `source`, or by themselves."""
    stored = [] if node is None else [name for name in names(node) if isinstance(name.ctx, ast.Store)]
    return {**state, **{name.id: {source or name} for name in stored}}


def join(*states):
    """What may hold where several ways meet."""
    flowing = [state for state in states if state is not None]
    if not flowing:
        return None
    return {name: set().union(*(s.get(name, set()) for s in flowing)) for s in flowing for name in s}


def taken_over(source):
    """(name, line of the loop, line of the use): a use that may see the name of a loop that has ended."""
    tree = ast.parse(source)
    return sorted(
        set().union(*(Flow(node).found for node in ast.walk(tree) if isinstance(node, FUNCTIONS)), set())
    )


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_loop_takes_over_a_name_that_is_still_used(path):
    assert not taken_over(path.read_text(encoding="utf-8"))


def test_the_search_finds_a_loop_in_a_loop_that_overwrites_a_step():
    source = """
def judge(rows, k):
    for row in rows:
        if row.flies:
            score(row, k)
        else:
            for k in range(3):
                row[k] = 0
"""
    assert taken_over(source) == [("k", 7, 5)]


@pytest.mark.parametrize(
    "body",
    [
        "    for k in range(3):\n        use(k)\n    k = 1\n    use(k)",  # another loop, another meaning
        "    use(k)\n    for k in range(3):\n        use(k)",
        "    for j in range(3):\n        use(k)\n    for k in range(3):\n        use(k)",
        "    return [k for k in range(3)] + [k]",  # a comprehension keeps its names to itself
    ],
)
def test_the_search_leaves_loops_alone_that_overwrite_nothing_of_use(body):
    assert taken_over(f"def f(k):\n{body}\n") == []
