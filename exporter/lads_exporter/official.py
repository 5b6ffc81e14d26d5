"""The official environments, driven by lads' random streams.

`OfficialKitchen` is FrankaKitchen-v1 of gymnasium-robotics: its own physics, its own task checks. Two things are set from
outside: the numbers behind its observation noise (numpy's PCG64 stream of (seed, instruction, episode), as everywhere in
lads), and for noise `v0` the amplitudes of D4RL. Needs the extra `test` of this package.
"""

import numpy as np

from .config import UserError

SUB_TASKS = ["microwave", "kettle", "bottom burner", "top burner", "light switch", "slide cabinet", "hinge cabinet"]

# pos_noise_amp of franka_config.xml for the 30 positions.
AMPLITUDES = np.array([0.1] * 9 + [0.005] * 2 + [0.0005] * 6 + [0.005] * 3 + [0.1] * 3 + [0.005] * 3 + [0.1] * 3 + [0.005])

# Ratios for the robot and the objects.
NOISE = {"none": (0.0, 0.0), "v0": (0.1, 0.1), "v1": (0.01, 0.0005)}


class Noise:
    """Replaces the official environment's generator: hands out our stream's 30 numbers per observation.

    The official environment draws four times per observation: robot positions, robot velocities, object positions, object velocities.
    Ours draws the 30 positions at once; velocities are not part of our observation and get no noise. `object_scale` turns the amplitudes
    that FrankaKitchen-v1 gives the objects into ours.
    """

    def __init__(self, entropy, object_scale):
        self.stream = np.random.default_rng(entropy)
        self.object_scale = object_scale
        self.draws = 0

    def uniform(self, low, high, size):
        turn, self.draws = self.draws % 4, self.draws + 1
        if turn == 0:
            self.numbers = self.stream.uniform(low, high, 30)
        return [self.numbers[:9], np.zeros(9), self.numbers[9:] * self.object_scale, np.zeros(20)][turn]


def scalar_joint(model, name):
    import mujoco

    joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    assert joint != -1 and int(model.jnt_type[joint]) in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    return joint


def joint_qpos(model, data, name):
    address = model.jnt_qposadr[scalar_joint(model, name)]
    return data.qpos[address : address + 1].copy()


def joint_qvel(model, data, name):
    address = model.jnt_dofadr[scalar_joint(model, name)]
    return data.qvel[address : address + 1].copy()


def positions(observation):
    """Takes the 30 positions out of the official 59 numbers."""
    return np.concatenate([observation["observation"][:9], observation["observation"][18:39]])


class OfficialKitchen:
    """FrankaKitchen-v1 with the observation, the noise and the latched completions of lads' `franka-kitchen`, version 1."""

    ID, VERSION, MAX_STEPS = "franka-kitchen", "1", 280
    SUB_TASKS = SUB_TASKS

    def __init__(self, noise="v0"):
        try:
            from gymnasium_robotics.envs.franka_kitchen import kitchen_env
            from gymnasium_robotics.utils import mujoco_utils
        except ImportError as error:
            raise UserError(f"the official environment is not installed ({error}); run: pip install -e 'exporter[test]'") from error
        if noise not in NOISE:
            raise UserError(f"unknown noise level {noise!r}: use {', '.join(NOISE)}")
        # MuJoCo's joint types are no longer members of a tuple of its enumeration since 3.12, which is all that stops FrankaKitchen-v1.
        mujoco_utils.get_joint_qpos, mujoco_utils.get_joint_qvel = joint_qpos, joint_qvel
        robot, objects = NOISE[noise]
        self.official = kitchen_env.KitchenEnv(
            tasks_to_complete=SUB_TASKS,
            terminate_on_tasks_completed=False,
            remove_task_when_completed=False,
            robot_noise_ratio=robot,
            object_noise_ratio=objects,
        )
        # FrankaKitchen-v1 takes the objects' amplitudes from one place too early; D4RL, whose noise v0 is, does not.
        official = self.official.robot_env.robot_pos_noise_amp[8:]
        self.object_scale = AMPLITUDES[9:] / official if noise == "v0" else np.ones(21)

    @staticmethod
    def versions():
        import gymnasium
        import gymnasium_robotics
        import mujoco

        return {
            "gymnasium": gymnasium.__version__,
            "gymnasium-robotics": gymnasium_robotics.__version__,
            "mujoco": mujoco.__version__,
        }

    def max_steps(self, split):
        """Returns the control steps of an episode, the same in every split."""
        return self.MAX_STEPS

    def reset(self, entropy, commanded=()):
        """Starts the episode of (seed, instruction, episode), the same whatever is commanded -> observation [30]."""
        self.official.robot_env._np_random = Noise(entropy, self.object_scale)
        observation, _ = self.official.reset()
        self.steps, self.completions = 0, {}
        return positions(observation)

    def step(self, action):
        """Executes an action -> observation [30]; `completions` maps a sub-task to the first step, from 1, after which it was done."""
        observation, _, _, _, info = self.official.step(action)
        self.steps += 1
        for task in sorted(info["step_task_completions"], key=SUB_TASKS.index):
            self.completions.setdefault(task, self.steps)
        return positions(observation)

    def succeeded(self, commanded):
        """Whether an instruction that commands these sub-tasks is carried out."""
        return all(task in self.completions for task in commanded)

    def state(self):
        """Noise-free quantities of the observation [30]."""
        return self.official.data.qpos.copy()

    def close(self):
        self.official.close()


def _lorel_table(noise):
    from .lorel_table import LorelTable  # needs the simulator's package

    return LorelTable(noise)


ENVIRONMENTS = {OfficialKitchen.ID: OfficialKitchen, "lorel-table": _lorel_table}
