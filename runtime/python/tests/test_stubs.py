"""Tests that the stubs of the native half match the module."""

import ast
import inspect
from pathlib import Path

import lads
from lads import _lads

STUBS = ast.parse((Path(lads.__file__).parent / "_lads.pyi").read_text())
# What every class of Python has.
COMMON = {"__doc__", "__module__", "__new__", "__repr__", "__eq__", "__ne__", "__ge__", "__gt__", "__le__", "__lt__", "__hash__", "__reduce__"}


def parameters(node):
    """Returns the names of a function's parameters in the stubs, with the number of those that have a default."""
    arguments = node.args
    names = [argument.arg for argument in [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]]
    defaults = len(arguments.defaults) + sum(value is not None for value in arguments.kw_defaults)
    return [name for name in names if name != "self"], defaults


def signature(function):
    """Returns the names of a function's parameters in the module, with the number of those that have a default."""
    found = [row for row in inspect.signature(function).parameters.values() if row.kind is not row.VAR_POSITIONAL]
    found = [row for row in found if row.name != "self"]
    return [row.name for row in found], sum(row.default is not row.empty for row in found)


def is_property(node):
    return any(isinstance(decorator, ast.Name) and decorator.id == "property" for decorator in node.decorator_list)


def test_functions_and_classes_are_the_modules():
    functions = {node.name: node for node in STUBS.body if isinstance(node, ast.FunctionDef)}
    classes = {node.name: node for node in STUBS.body if isinstance(node, ast.ClassDef)}
    public = {name for name in vars(_lads) if not name.startswith("__")}
    assert functions.keys() | classes.keys() == public
    for name, node in functions.items():
        assert parameters(node) == signature(getattr(_lads, name)), name
        assert getattr(_lads, name).__doc__, name


def test_members_are_the_modules():
    for node in STUBS.body:
        if not isinstance(node, ast.ClassDef):
            continue
        found = getattr(_lads, node.name)
        members = {member.name: member for member in node.body}
        assert members.keys() - {"__init__"} == {name for name in vars(found) if name not in COMMON}, node.name
        assert found.__doc__, node.name
        for name, member in members.items():
            if is_property(member):
                assert inspect.isgetsetdescriptor(getattr(found, name)), f"{node.name}.{name}"
                assert getattr(found, name).__doc__, f"{node.name}.{name}"
            elif name == "__init__":
                assert parameters(member) == signature(found), node.name
            elif not name.startswith("__"):
                assert parameters(member) == signature(getattr(found, name)), f"{node.name}.{name}"
                assert getattr(found, name).__doc__, f"{node.name}.{name}"


def test_the_package_is_typed():
    assert (Path(lads.__file__).parent / "py.typed").exists()
    assert all(hasattr(lads, name) for name in lads.__all__)
