"""The LOReL table in Python: the simulator's own Python package on the scene of the Rust environment.

An implementation of its own, not a binding: reference rollouts and the Rust environment's tests stand on it. The
random draws are numpy's, in the same order. Needs `make setup` for the meshes.
"""

from pathlib import Path

import mujoco
import numpy as np

from .config import UserError

ROOT = Path(__file__).resolve().parents[2]
SCENE = ROOT / "sim-harness/src/environments/lorel/scene.xml"
ASSETS = ROOT / "vendor/assets/metaworld"

HOME = np.array([1.93333534, -0.499194428, -0.705384607, 0.801938933, -2.58353956, -1.46084202, 0.0536478328, 0.04, -0.03])
QUATERNION = np.array([0.5**0.5, 0.0, 0.5**0.5, 0.0])
MOCAP_LOW, MOCAP_HIGH = np.array([-0.3, 0.4, 0.0]), np.array([0.3, 0.8, 0.15])
MUG_START = np.array([-0.2, 0.65])
POSTURES, POSTURE_STREAM = 256, 0x706F737475726573
WHITE, BLACK, FAUCET, DRAWER = 9, 11, 13, 14
FULL_STATE = mujoco.mjtState.mjSTATE_INTEGRATION

# name: (element of the observation, sign, threshold); left is +x, down is +y
SUB_TASKS = {
    "open drawer": (DRAWER, -1, 0.02),
    "close drawer": (DRAWER, 1, 0.02),
    "turn faucet left": (FAUCET, 1, np.pi / 10),
    "turn faucet right": (FAUCET, -1, np.pi / 10),
} | {
    f"move {colour} mug {way}": (first + axis, sign, 0.02)
    for colour, first in (("white", WHITE), ("black", BLACK))
    for way, axis, sign in (("left", 0, 1), ("right", 0, -1), ("down", 1, 1), ("up", 1, -1))
}


class LorelTable:
    """The environment `lorel-table`, version 1; `reset` and `step` return the 15 positions."""

    ID, VERSION = "lorel-table", "1"
    SUB_TASKS = list(SUB_TASKS)

    def __init__(self, noise="none"):
        if noise != "none":
            raise UserError(f"unknown noise level {noise!r}: {self.ID} observes without noise, so give none")
        if not ASSETS.is_dir():
            raise UserError(f"the simulator's assets are missing ({ASSETS}): run make setup")
        spec = mujoco.MjSpec.from_file(str(SCENE))
        spec.modelfiledir = str(ASSETS)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.settled = {}

    def _advance(self, physics_steps):
        mujoco.mj_step(self.model, self.data, physics_steps)

    def _settle(self, posture):
        if posture not in self.settled:
            hand = np.array([0.0, 0.5, 0.07])
            if posture > 0:
                draw = np.random.default_rng([POSTURE_STREAM, posture])
                x, y = (draw.uniform(middle - 0.05, middle + 0.05) for middle in MUG_START)
                hand = np.array([x, y, 0.07])
            data = self.data
            mujoco.mj_resetData(self.model, data)
            data.qpos[:9], data.qpos[9:13] = HOME, [-0.6, 0.4, -0.6, 0.9]
            data.mocap_quat[0], data.mocap_pos[0] = QUATERNION, [0.0, 0.5, 0.07]
            mujoco.mj_forward(self.model, data)
            data.mocap_pos[0], data.ctrl[:] = hand, [-1, 1]
            self._advance(500)
            data.ctrl[:] = 0
            self._advance(500)
            state = np.zeros(mujoco.mj_stateSize(self.model, FULL_STATE))
            mujoco.mj_getState(self.model, data, state, FULL_STATE)
            self.settled[posture] = state
        return self.settled[posture]

    @staticmethod
    def versions():
        return {"mujoco": mujoco.__version__}

    @staticmethod
    def max_steps(split):
        """Returns the control steps of an episode of an instruction in this split."""
        return 40 if split.startswith("composite") else 20

    def reset(self, entropy, commanded=()):
        """Starts the episode of (seed, instruction, episode); `commanded`: names of sub-tasks, none for a recorded trajectory."""
        draw, data = np.random.default_rng(entropy), self.data
        posture = 0 if draw.random() < 0.5 else 1 + int(draw.random() * POSTURES)
        mujoco.mj_setState(self.model, data, self._settle(posture), FULL_STATE)
        for mug in (WHITE, BLACK):
            data.qpos[mug : mug + 2] = MUG_START + draw.uniform(-0.1, 0.1, 2)
        data.qpos[FAUCET] = draw.uniform(-np.pi / 4, np.pi / 4)
        data.qpos[DRAWER] = draw.uniform(-0.09, 0.0)
        mujoco.mj_forward(self.model, data)
        self._advance(100)
        if commanded:
            self._prepare([task for task in SUB_TASKS if task in commanded], draw)
        self.start, self.steps, self.completions = data.qpos.copy(), 0, {}
        return data.qpos.copy()

    def _prepare(self, commanded, draw):
        data, hand = self.data, [0.0, 0.45, 0.1]
        for name in commanded:
            element, sign, _ = SUB_TASKS[name]
            if element == DRAWER:
                data.qpos[DRAWER] = draw.uniform(-0.05, 0.0) if sign < 0 else draw.uniform(-0.15, -0.05)
            elif element == FAUCET:
                data.qpos[FAUCET] = draw.uniform(-np.pi / 5, np.pi / 5)
            else:
                mug = WHITE if element < BLACK else BLACK
                data.qpos[mug : mug + 2] = MUG_START + draw.uniform(-0.05, 0.05, 2)
                hand = [-0.1, 0.55, 0.1]
        mujoco.mj_forward(self.model, data)
        data.mocap_pos[0], data.ctrl[:] = hand, [-1, 1]
        self._advance(550)
        data.qvel[:], data.qacc[:] = 0, 0
        self._advance(1)

    def step(self, action):
        moved = self.data.mocap_pos[0] + 0.2 * np.clip(action[:3], -1, 1)
        self.data.mocap_pos[0] = np.clip(moved, MOCAP_LOW, MOCAP_HIGH)
        self.data.ctrl[:] = [action[4], -action[4]]
        self._advance(5)
        self.steps += 1
        for task in SUB_TASKS:
            if self.succeeded([task]):
                self.completions.setdefault(task, self.steps)
        return self.data.qpos.copy()

    def state(self):
        return self.data.qpos.copy()

    def close(self):
        """Does nothing: the environment holds nothing that must be closed."""

    def succeeded(self, commanded):
        """Whether all sub-tasks hold now, relative to the start."""
        change = self.data.qpos - self.start
        return all(sign * change[element] > threshold for element, sign, threshold in (SUB_TASKS[name] for name in commanded))
