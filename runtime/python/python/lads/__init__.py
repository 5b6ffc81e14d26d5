"""Policies in Python, by the runtime that runs them in the machine.

`open` reads a policy, a bundle (.onnx) or a compiled image (.lads), and `import_onnx` any other ONNX policy; `Policy.controller` runs it;
`Controller.step` turns an observation into an action. `lads.gym` evaluates a controller in any environment of Gymnasium's API,
`lads.vector` steps many of them over threads, `lads.language` turns a sentence in any words into an instruction, and `verify` compares one with the policy that was trained. Every refusal is an exception
of `lads.errors`.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING

from . import errors
from ._lads import Controller, Policy, Selected, StepReport, __version__, forked, from_image, import_onnx, open, template
from .errors import LadsError

if TYPE_CHECKING:
    from . import gym, language, vector
    from .contract import Channel, Context, Contract, Element, Golden, Instruction, Language, Nearest, SelfTest
    from .recording import Recorder
    from .verification import Certificate, Reply, verify

# What a control loop does not need is imported when it is first asked for: that is three quarters of the time of an import.
_LATER = {
    **dict.fromkeys(("gym", "language", "vector"), None),
    **dict.fromkeys(("Channel", "Context", "Contract", "Element", "Golden", "Instruction", "Language", "Nearest", "SelfTest"), "contract"),
    **dict.fromkeys(("Certificate", "Reply", "verify"), "verification"),
    "Recorder": "recording",
}


def __getattr__(name):
    if name not in _LATER:
        raise AttributeError(f"module 'lads' has no attribute {name!r}")
    module = _LATER[name]
    found = import_module(f".{name}", __name__) if module is None else getattr(import_module(f".{module}", __name__), name)
    globals()[name] = found
    return found


def __dir__():
    return sorted(__all__)


# A controller that a fork has copied is refused in the child.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=forked)

__all__ = [
    "Certificate",
    "Channel",
    "Context",
    "Contract",
    "Controller",
    "Element",
    "Golden",
    "Instruction",
    "LadsError",
    "Language",
    "Nearest",
    "Policy",
    "Recorder",
    "Reply",
    "SelfTest",
    "Selected",
    "StepReport",
    "__version__",
    "errors",
    "from_image",
    "gym",
    "import_onnx",
    "language",
    "open",
    "template",
    "vector",
    "verify",
]
