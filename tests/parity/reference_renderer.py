"""Frames of the LOReL table by MuJoCo's own renderer in Python, for test_rendering.py.

    python reference_renderer.py DATA.safetensors OUT.npy EVERY [RENDERING.json]

Writes frames [n, 64, 64, 3] of u8 of every EVERYth observation; the scene's own quality without a rendering. A program of its own: which OpenGL
the package mujoco takes is settled by MUJOCO_GL when it is first imported, and other tests import it before. Ends with 3 where there is no EGL.
"""

import json
import os
import pathlib
import re
import sys

os.environ["MUJOCO_GL"] = "egl"
os.environ["LP_NUM_THREADS"] = "0"  # as lads-run draws: sim-harness/src/film/driver.rs
import mujoco  # noqa: E402
import numpy as np  # noqa: E402
from safetensors.numpy import load_file  # noqa: E402
from programs import ROOT  # noqa: E402

NO_EGL = 3
SCENE = ROOT / "sim-harness/src/environments/lorel/scene.xml"
ASSETS = pathlib.Path(os.environ.get("LADS_VENDOR", ROOT / "vendor")) / "assets/metaworld"


def scene(rendering):
    text = re.sub(r'meshdir="meshes" texturedir="textures"', f'meshdir="{ASSETS}/meshes" texturedir="{ASSETS}/textures"', SCENE.read_text())
    model = mujoco.MjModel.from_xml_string(text)
    if rendering:
        model.vis.quality.shadowsize, model.vis.quality.offsamples = rendering["shadow_size"], rendering["samples"]
        model.vis.map.shadowclip = rendering["shadow_clip"]
        model.mat_reflectance[:] = 0
        for body in rendering["hidden"]:
            model.geom_rgba[model.geom_bodyid == mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body), 3] = 0
    return model


def main(data, out, every, rendering=None):
    model = scene(rendering and json.loads(pathlib.Path(rendering).read_text()))
    states, found = mujoco.MjData(model), []
    try:
        renderer = mujoco.Renderer(model, 64, 64)
    except Exception as error:
        print(f"no EGL: {error}", file=sys.stderr)
        sys.exit(NO_EGL)
    for row in load_file(data)["observations"][:: int(every)]:
        states.qpos[:] = row
        mujoco.mj_kinematics(model, states)
        mujoco.mj_camlight(model, states)
        renderer.update_scene(states, "cam0")
        found.append(renderer.render())
    renderer.close()
    np.save(out, np.array(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
