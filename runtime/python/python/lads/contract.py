"""The contract of a policy, as frozen dataclasses; read from the report of `Policy.inspect`, which never lacks a field."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

DTYPES = {"f32": np.dtype(np.float32), "u8": np.dtype(np.uint8), "i32": np.dtype(np.int32)}


@dataclass(frozen=True)
class Element:
    """One element of a channel. The physical value is `reference + offset + scale * value`."""

    name: str
    unit: str
    """Unit of the value, `1` for a dimensionless one."""
    min: float
    max: float
    joint: str
    """Joint that the element belongs to; empty for none."""
    interface: str
    """Quantity of the joint: position, velocity, effort; empty where the bundle does not say."""
    scale: float
    offset: float
    physical_unit: str
    """Unit of the physical value; empty where the bundle does not say."""


@dataclass(frozen=True)
class Channel:
    """One channel, an input or output of the policy: an observation, the action, the words of an instruction, noise, a demonstration."""

    name: str
    role: str
    """Role of the channel: `observation`, `action`, `instruction`, `noise` or `demonstration`."""
    dtype: np.dtype
    shape: tuple[int, ...]
    elements: tuple[Element, ...]
    """Elements in order; empty for images and the like, whose elements have no names."""
    min: float | None
    """Smallest value of every element if the elements have no names, otherwise None."""
    max: float | None
    quaternion_order: str
    """Order of the components of quaternions: `none`, `wxyz` or `xyzw`."""
    reference: str


@dataclass(frozen=True)
class Instruction:
    """An instruction that the policy knows."""

    id: str
    text: str
    words: int
    """Number of word embeddings."""


@dataclass(frozen=True)
class Language:
    """The language encoder that made the word embeddings."""

    encoder: str
    sha256: str
    dim: int
    """Number of elements of a word embedding."""
    acceptance: float
    """Smallest similarity to a known instruction at which another sentence may be followed; above 1 if none may be."""


@dataclass(frozen=True)
class Context:
    """Capacity of a policy's context."""

    words: int
    """Number of words of the longest instruction; 0 for a policy that takes none."""
    steps: int | None
    """Number of control steps that the context holds; None if it is unbounded."""
    beyond: str | None
    """Behaviour after that many control steps: `restart` or `refuse`."""


@dataclass(frozen=True)
class Contract:
    """The contract of a policy: its channels, instructions and rules."""

    family: str
    environment: str
    environment_version: str
    control_period: float
    """Control period, the time from one control step to the next, in seconds."""
    channels: tuple[Channel, ...]
    indices: int
    """Number of indices, such as those of latent plans, that the policy selects from; 0 for a policy that selects nothing."""
    decision: str
    """Rule that picks an index: `argmax` or `sample`."""
    noise: str
    """Source of noise: `zero` or `seeded`."""
    noise_elements: int
    """Largest number of elements of noise that a control step takes."""
    context: Context
    language: Language | None
    instructions: tuple[Instruction, ...]
    bundle_sha256: str
    """SHA-256 of the bundle that the image was compiled from."""

    @property
    def observations(self) -> tuple[Channel, ...]:
        """The channels that are given in every control step."""
        return tuple(channel for channel in self.channels if channel.role == "observation")

    @property
    def action(self) -> Channel:
        """The channel that every control step writes."""
        return next(channel for channel in self.channels if channel.role == "action")


@dataclass(frozen=True)
class Nearest:
    """The known instruction that a sentence is most similar to."""

    instruction: Instruction
    similarity: float
    """Mean over the sentence's words, but for the end mark of several, of the cosine with the instruction's word that is most like each; -1 to 1."""
    accepted: bool
    """Whether the contract lets a sentence of this similarity be followed."""


@dataclass(frozen=True, eq=False)
class Golden:
    """The recorded episode of the self-test."""

    instruction: str | None
    """Id of the instruction that was followed."""
    observations: dict[str, np.ndarray]
    """Observations by channel, each `[steps, *shape]`."""
    noise: np.ndarray
    """All draws of each step, `[steps, noise_elements]`."""
    selected: np.ndarray | None
    """The index in force in each step; None for a policy that selects nothing."""
    actions: np.ndarray
    """Actions `[steps, actions]`, inside the limits."""
    tolerance: float
    """Largest difference of an action that the self-test accepts."""


@dataclass(frozen=True)
class SelfTest:
    """Measurements of a self-test that passed."""

    steps: int
    largest_error: float
    """Largest absolute difference of an action element, in its unit."""
    tolerance: float
    digest: str
    """FNV-1a of 32 bits over all actions: two machines with the same digest computed the same bits."""


def read(report: str) -> Contract:
    """Returns the contract in a report of `Policy.inspect`, given as JSON."""
    report = json.loads(report)
    found = report["contract"]
    return Contract(
        family=found["family"],
        environment=found["environment"]["id"],
        environment_version=found["environment"]["version"],
        control_period=found["control_period_s"],
        channels=tuple(_channel(row) for row in found["channels"]),
        indices=found["indices"],
        decision=found["decision"]["rule"],
        noise=found["noise"]["rule"],
        noise_elements=found["noise_elements"],
        context=Context(**found["context"]),
        language=found["language"] and Language(**found["language"]),
        instructions=tuple(Instruction(**row) for row in found["instructions"]),
        bundle_sha256=report["bundle_sha256"],
    )


def _channel(row):
    return Channel(
        name=row["name"],
        role=row["role"],
        dtype=DTYPES[row["dtype"]],
        shape=tuple(row["shape"]),
        elements=tuple(Element(**element) for element in row["elements"]),
        min=row["min"],
        max=row["max"],
        quaternion_order=row["quaternion_order"],
        reference=row["reference"],
    )
