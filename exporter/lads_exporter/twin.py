"""The controller's twin: runs a bundle with ONNX Runtime, entry by entry, by the schedule of its family (`families`).

Golden episodes and tests are made with it; the product's control loop is the Rust core, which shares nothing with this file
but the contract. Values are bound by their names: a channel's name is that channel, `timestep`, `phase`, `pass` and `index` are the
controller's integers, `action` or `previous_action` as an input is the last executed action, `past_key_values.*` and `present.*`
are the keys and values of the entry's level, and every other name is a state. Nothing is taken back after an error, and a plan is always
the one with the largest logit: what a contract's rule `sample` would draw is the runtime's own affair.
"""

from contextlib import suppress

import numpy as np
import onnxruntime
from onnx.utils import Extractor

from . import contract as contracts
from .config import UserError
from .contract import ACTION, NOISE
from .families import FAMILIES
from .normals import Normals

PAST, PRESENT = "past_key_values.", "present."
PREVIOUS = ("action", "previous_action")


def entries(model):
    """Lists the names of all entries of a bundle, in the order of their outputs."""
    return list(dict.fromkeys(value.name.rsplit("/", 1)[0] for value in model.graph.output))


def extract(model, entry):
    """Extracts one entry of a bundle as a model of its own."""
    names = lambda values: [value.name for value in values if value.name.startswith(entry + "/")]
    return Extractor(model).extract_model(names(model.graph.input), names(model.graph.output))


class Entry:
    """One entry in an ONNX Runtime session; names are local to it."""

    def __init__(self, model, name):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.log_severity_level = 3
        data = extract(model, name).SerializeToString()
        self.name = name
        self.session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        local = lambda values: {value.name.removeprefix(name + "/"): value.shape for value in values}
        self.inputs, self.outputs = local(self.session.get_inputs()), local(self.session.get_outputs())

    def __call__(self, **inputs):
        """Runs the entry: local names to arrays -> local names to arrays."""
        return self.run(inputs)

    def run(self, inputs):
        results = self.session.run([f"{self.name}/{name}" for name in self.outputs], {f"{self.name}/{name}": value for name, value in inputs.items()})
        return dict(zip(self.outputs, results))


class Recorded:
    """Source of noise that was drawn before: draws are handed out in their order."""

    def __init__(self, draws):
        self.draws = np.asarray(draws, np.float32).ravel()

    def draw(self, count):
        if count > len(self.draws):
            raise UserError(f"{count} more numbers of noise are asked for, {len(self.draws)} are recorded")
        taken, self.draws = self.draws[:count], self.draws[count:]
        return taken


class Zero:
    """Source of zeros: the mean plan, or denoising without chance."""

    def draw(self, count):
        return np.zeros(count, np.float32)


def noise_source(contract):
    """Makes the source of noise that the contract names: seeded normals, or zeros. None for a policy without noise."""
    if not contracts.of_role(contract, "noise"):
        return None
    family = contract["family"]
    given = family["noise"] if "noise" in family else family["decision"]
    if given["rule"] in ("zero", "mean"):
        return Zero()
    return Normals(given["seed"])


class _State:
    """Value of a state, what clears it, and for a ring its valid rows, oldest first."""

    def __init__(self, shape, scope="episode", ring=0, fill="zero"):
        self.shape, self.scope, self.ring, self.fill = shape, scope, ring, fill
        self.clear()

    def clear(self):
        self.rows = []
        self.value = None if self.ring else np.zeros(self.shape, np.float32)

    def append(self, row):
        self.rows = [*self.rows, row.reshape(self.shape)][-self.ring :]

    def window(self):
        """Returns the ring's window [ring, width], oldest first."""
        missing = self.ring - len(self.rows)
        pad = self.rows[0] if self.fill == "first" and self.rows else np.zeros(self.shape, np.float32)
        return np.stack([pad] * missing + self.rows)


class Twin:
    """A policy as its controller runs it: `set_instruction`, `reset`, `step`, and `executed` where another action was taken."""

    def __init__(self, model, noise=None):
        """Makes a twin; model: a bundle as ONNX; noise: an object whose `draw(n)` gives n float32 numbers, else the contract's own
        source."""
        self.contract = contracts.of(model)
        self.family = self.contract["family"]
        self.entries = {name: Entry(model, name) for name in entries(model)}
        self.channels = {row["name"]: row for row in self.contract["channels"]}
        self.noise = noise or noise_source(self.contract)
        self.limits = [np.array(side, np.float32) for side in contracts.limits(contracts.action(self.contract))]
        context = self.contract.get("context")
        self.steps, self.beyond = (context["steps"], context["beyond"]) if context else (None, None)
        self.period = contracts.period(self.contract)
        self.schedule = FAMILIES[self.family["kind"]].step
        self.states = self._states()
        self.caches, self.words, self.index, self.draws = {}, {}, None, []
        self._begin(("instruction", "episode"))

    def _states(self):
        """Makes the states of the contract, and for families every name that an entry reads and none of the controller's own is."""
        found = {}
        for row in self.contract.get("states", []):
            scope = row.get("cleared_by", "episode")
            if row["kind"] == "ring":
                shape = self.channels[row["source"]]["shape"] if row.get("source") else row["shape"]
                found[row["name"]] = _State(shape, scope, row["rows"], row["fill"])
            else:
                found[row["name"]] = _State(row["shape"], scope)
        rings = FAMILIES[self.family["kind"]].rings(self.family)
        taken = {"timestep", "phase", "pass", "index", *PREVIOUS, *self.channels}
        for name, entry in self.entries.items():
            if name not in ("instruction/lookup", "trajectory_encoder/encode", "high_level/instruct"):
                for port, shape in entry.inputs.items():
                    if port not in taken and port not in found and not port.startswith(PAST):
                        found[port] = _State(shape, "episode", rings.get(port, 0))
        return found

    def set_instruction(self, instruction):
        """Sets an instruction: an index of the contract's, or words [n, E]. A new episode begins."""
        if "instruction/lookup" not in self.entries:
            raise UserError("the policy has no instructions")
        if np.ndim(instruction) == 0:
            known = self.entries["instruction/lookup"](id=np.array([instruction]))
            words, length = known["words"], int(known["length"][0])
        else:
            most, dim = contracts.words(self.contract)
            length = len(instruction)
            words = np.zeros((1, most, dim), np.float32)
            words[0, :length] = instruction
        present = self.entries["high_level/instruct"](words=words)
        self.words = {name.replace(PRESENT, PAST): rows[:, :, :length] for name, rows in present.items()}
        self._begin(("instruction", "episode"))

    def reset(self):
        """Starts a new episode under the same instruction. The stream of noise goes on."""
        self._begin(("episode",))

    def _begin(self, scopes):
        self.previous = np.zeros((1, *contracts.action(self.contract)["shape"]), np.float32)
        self._restart(scopes)

    def _restart(self, scopes=("episode",)):
        """Restarts the context: words stay, and so do the last action, the stream of noise and the selected index."""
        self.timestep = 0
        self.caches = {"high_level": dict(self.words)}
        for state in self.states.values():
            if state.scope in scopes:
                state.clear()

    def executed(self, action):
        """Sets the action that was really executed, where it was not the last step's."""
        self.previous = np.asarray(action, np.float32).reshape(self.previous.shape)

    def step(self, channels):
        """Runs a control step; channels: name -> array of the channel's shape, or the array itself where there is one -> action [A],
        selected index or None."""
        if not isinstance(channels, dict):
            channels = {contracts.observation(self.contract)["name"]: channels}
        if self.timestep == self.steps:
            if self.beyond == "refuse":
                raise UserError(f"the context of {self.steps} control steps is full, and the contract says to refuse")
            self._restart()
        self.observed = {name: self._given(name, value) for name, value in channels.items()}
        for row in self.contract.get("states", []):
            if row.get("source"):
                self.states[row["name"]].append(self.observed[row["source"]])
        self.draws, self.fresh = [], False
        self.action = None
        if "features" in self.family:
            self.run("observation_encoder/encode")
        self.schedule(self)
        self.action = np.clip(self.action[0], *self.limits)
        self.previous = self.action[None]
        self.timestep += 1
        return self.action, self.index

    def _given(self, name, value):
        row = self.channels[name]
        return np.ascontiguousarray(value, contracts.DTYPES[row["dtype"]]).reshape(1, *row["shape"])

    @property
    def decides(self):
        """Returns whether a plan is made at this step."""
        return self.timestep % self.period == 0

    @property
    def logits(self):
        """Returns the logits [M] that the last selection was made from."""
        return self.states["logits"].value.ravel()

    def select(self):
        """Selects the plan with the largest logit, the first of equal ones."""
        self.index, self.fresh = int(self.logits.argmax()), True

    def clear(self, level):
        """Forgets the keys and values of a level."""
        self.caches.pop(level, None)

    def run(self, name, number=0, ring=None):
        """Runs an entry and stores its outputs. `number` is the pass of a repeated call, `ring` the state that it walks along."""
        entry = self.entries.get(name)
        if entry is None:
            raise UserError(f"the graph has no entry {name}, which the contract's family runs")
        cache = self.caches.setdefault(name.split("/")[0], {})
        inputs = {port: self._input(port, shape, cache, number, ring) for port, shape in entry.inputs.items()}
        for port, value in entry.run(inputs).items():
            self._output(port, value, cache)

    def repeat(self, name, count, ring=None):
        for number in range(count):
            self.run(name, number, ring)

    def _input(self, port, shape, cache, number, ring):
        integers = {"timestep": self.timestep, "phase": self.timestep % self.period, "pass": number, "index": self.index}
        if port in integers:
            return np.array([integers[port]], np.int64)
        if port == NOISE and NOISE in self.channels:
            drawn = self.noise.draw(int(np.prod(self.channels[NOISE]["shape"])))
            self.draws.append(drawn)
            return drawn.reshape(shape)
        if port in self.observed:
            return self.observed[port].reshape(shape)
        if port in PREVIOUS:
            return self.previous.reshape(shape)
        if port.startswith(PAST):
            return cache.get(port, np.zeros([size if isinstance(size, int) else 0 for size in shape], np.float32))
        state = self.states.get(port)
        if state is None:
            raise UserError(f"an entry reads {port}, which is no channel, no state and nothing of the controller's")
        if state.ring:
            return (state.rows[number] if port == ring else state.window()).reshape(shape)
        return state.value.reshape(shape)

    def _output(self, port, value, cache):
        if port.startswith(PRESENT):
            cache[port.replace(PRESENT, PAST)] = value
        elif port == ACTION:
            self.action = value.reshape(self.previous.shape)
        else:
            name = port.removeprefix("next_")
            state = self.states.setdefault(name, _State(value.shape))
            if state.ring:
                state.append(value)
            else:
                state.value = value


class Rollout:
    """Record of what a policy did on given observations: arrays over the steps."""

    def __init__(self, twin):
        self.twin, self.count = twin, _len_of_noise(twin.contract)
        self.actions, self.selected, self.margins, self.decided_at, self.logits, self.draws = [], [], [], [], [], []

    def step(self, channels):
        action, index = self.twin.step(channels)
        self.actions.append(action)
        self.selected.append(-1 if index is None else index)
        self.draws.append(np.concatenate(self.twin.draws) if self.twin.draws else np.zeros(0, np.float32))
        with suppress(KeyError):
            self.logits.append(self.twin.logits.copy())
        if self.twin.fresh:
            best = np.sort(self.twin.logits)[-2:]
            self.margins.append(float(best[1] - best[0]))
            self.decided_at.append(len(self.actions) - 1)

    @property
    def margin(self):
        """Returns the smallest lead of the best over the second best logit at any selection."""
        return min(self.margins, default=float("inf"))

    def clear_until(self, margin):
        """Returns the number of steps before the first selection with a smaller lead."""
        close = (step for step, lead in zip(self.decided_at, self.margins) if lead < margin)
        return next(close, len(self.actions))

    def tensors(self):
        """Returns `actions` [T, A], and where there are any `selected` [T] and `noise` [T, N]: all draws of a step in order, then zeros."""
        found = {"actions": np.stack(self.actions).astype(np.float32)}
        if any(index >= 0 for index in self.selected):
            found["selected"] = np.array(self.selected, np.int64)
        if self.count:
            most = max(len(row) for row in self.draws)
            found["noise"] = np.stack([np.pad(row, (0, most - len(row))) for row in self.draws])
        return found


def _len_of_noise(contract):
    return sum(int(np.prod(row["shape"])) for row in contracts.of_role(contract, "noise"))


def open_loop(twin, instruction, channels):
    """Replays recorded channels {name: [T, ...]} after an instruction (None: of a policy without) -> Rollout."""
    if instruction is None:
        twin.reset()
    else:
        twin.set_instruction(instruction)
    rollout = Rollout(twin)
    for t in range(len(next(iter(channels.values())))):
        rollout.step({name: rows[t] for name, rows in channels.items()})
    return rollout
