"""Imports go one way: between packages, between the rooms of a package, and from file to file."""

import ast

import pytest
from sources import ROOT, reads_sources

pytestmark = reads_sources
LAYERS = ["quad_envs", "controllers", "baselines", "benchmarks"]
# Rooms of a package from the ground up: a room imports from those before it.
FLOORS = {
    "quad_envs": "arguments episode_limit array_info plant compilation registration limits parameters "
    "constraints authority vehicles rotations references reward lanes dynamics disturbances formations "
    "graphs targets sensors observations tasks pictures envs wrappers "
    "formation_v0 target_tracking_v0 cooperative_estimation_v0",
    "controllers": "qp fallback disturbance controller model frame estimation mpc feedback team stability",
    "baselines": "interruptions errors files policies evaluation training sweeps report "
    "reproduction certify cli __main__",
}


def module_of(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_of(path): path for layer in LAYERS for path in sorted((ROOT / layer).rglob("*.py"))}


def imports_of(module):
    """Modules of the project that a file imports, wherever in the file, type checkers' imports included."""
    path, found = FILES[module], set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            package = module.split(".")[: None if path.name == "__init__.py" else -1]
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            names = {f"{base}.{alias.name}" for alias in node.names}
            found |= {name if name in FILES else base for name in names}
    return {name for name in found if name in FILES and name != module}


ARROWS = {module: imports_of(module) for module in FILES}


def room_of(module):
    return ".".join(module.split(".")[:2])


def rooms_of(package):
    """Room -> rooms of the same package that its files import; its own __init__ stands above all."""
    inside = [module for module in FILES if module.startswith(f"{package}.")]
    arrows = {room_of(module): set() for module in inside}
    for module in inside:
        arrows[room_of(module)] |= {room_of(other) for other in ARROWS[module] if other in inside}
    return {room: others - {room} for room, others in arrows.items()}


def circle(arrows):
    """What cannot be put in an order: the nodes left when those that need nothing more are taken away."""
    left = {node: set(others) for node, others in arrows.items()}
    while free := {node for node, others in left.items() if not others & left.keys()}:
        left = {node: others for node, others in left.items() if node not in free}
    return sorted(left)


@pytest.mark.parametrize("layer", LAYERS)
def test_no_file_imports_a_layer_above_its_own(layer):
    allowed = LAYERS[: LAYERS.index(layer) + 1]
    for module in FILES:
        if module.split(".")[0] == layer:
            assert {other.split(".")[0] for other in ARROWS[module]} <= set(allowed), module


@pytest.mark.parametrize("package", FLOORS)
def test_no_room_imports_a_room_above_it(package):
    floors = [f"{package}.{room}" for room in FLOORS[package].split()]
    rooms = rooms_of(package)
    assert set(floors) == set(rooms), "a new room: which floor is it on?"
    for room, others in rooms.items():
        above = {other for other in others if floors.index(other) > floors.index(room)}
        assert not above, room


@pytest.mark.parametrize("package", LAYERS)
def test_rooms_stand_in_no_circle(package):
    assert circle(rooms_of(package)) == []


def test_files_import_each_other_in_no_circle():
    assert circle(ARROWS) == []


@pytest.mark.parametrize(("package", "most"), [("quad_envs", 29), ("controllers", 12), ("baselines", 14)])
def test_packages_have_few_rooms(package, most):
    """Whoever looks for something reads this list first."""
    assert len(rooms_of(package)) <= most
