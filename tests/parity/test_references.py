"""Tests `lads-run verify` on a reference of every system of the paper's tables: small policies with random weights on the LOReL table, whose PyTorch
networks act over the whole history, and whose bundles act step by step in the runtime.

Run with `python -m pytest tests/parity` in the exporter's environment, after `cargo build -p lads-sim`. Skipped where either is missing.
"""

import json
import subprocess

import pytest

np = pytest.importorskip("numpy")
torch = pytest.importorskip("torch")
pytest.importorskip("lads_exporter.whole")
from lads_exporter import bundle, config, language, random_policy, reference, systems  # noqa: E402
from programs import newest  # noqa: E402

EQUIVALENT, DIFFERENT, INCONCLUSIVE = 0, 1, 3
VALUES = {
    "lang_dt": {},
    "lisa": {},
    "vae": {"rule": "sample"},
    "wo_cp": {"regressed": True},
    "lcsd": {"hidden": 32},
    "skilldiffuser": {"width": 16, "multiples": [1, 2], "passes": 4},
    "skilldiffuser-ddpm": {"width": 16, "multiples": [1, 2], "schedule": 12, "passes": 12},
}


def setting_of(system):
    """Makes a system's setting on the LOReL table: two instructions, one of them a composite, and words of a random encoder."""
    base = "lads" if system == "wo_cp" else system
    table, *beside = config.load("configs/lorel.toml", f"configs/lorel/{base}.toml").tables
    table["system"] |= VALUES[system]
    table["language"] |= {"encoder": "random-8", "pool": False}
    table["high_level"] |= {"hidden": 32, "heads": 2}
    environment, instructions = beside
    return config.from_tables(table, environment, {split: instructions[split][:1] for split in ("atomic", "composite")}, "test")


def write(system, folder):
    """Writes a random policy's bundle and its run -> path of the bundle."""
    setting = setting_of(system)
    encoded = language.encode(setting.config.language, [row["text"] for row in setting.instructions])
    torch.manual_seed(3)
    generator = torch.Generator().manual_seed(3)
    networks = systems.of(setting.config).Networks(setting, encoded).eval()
    random_policy.draw_weights(networks, generator)
    random_policy.place_normalizer(networks.normalizer, setting.environment["observation"])
    if hasattr(networks, "codebook"):
        networks.codebook.codes.copy_(torch.randn(networks.codebook.codes.shape, generator=generator))
    identity = {"tables": setting.tables, "dataset_sha256": "none"}
    folder.mkdir()
    torch.save({"identity": identity, "networks": networks.state_dict(), "position": {"stage": 9}}, folder / "checkpoint.pt")
    golden = ((0, random_policy.observations(setting, 20, seed)) for seed in range(200))
    model = bundle.assemble(networks, setting, encoded, {"dataset_sha256": "none", "seed": 3, "steps": {}}, golden)
    bundle.save(model, folder / "policy.onnx")
    return folder / "policy.onnx"


def verify(path, file):
    """Runs `lads-run verify` -> exit code, certificate."""
    certificate = path.with_name("certificate.json")
    command = [newest("lads-run"), "verify", "--model", path, "--reference", file, "--certificate", certificate]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode in (EQUIVALENT, DIFFERENT, INCONCLUSIVE), done.stderr
    return done.returncode, json.loads(certificate.read_text())


@pytest.mark.parametrize("system", list(VALUES))
def test_the_bundle_is_its_reference(system, tmp_path):
    path, file = write(system, tmp_path / "run"), tmp_path / "r.json"
    reference.write(path, file, run=tmp_path / "run", episodes=3, traced=2, noise="none")
    code, found = verify(path, file)
    policy = found["policy"]
    # Few episodes cannot show equivalence of rates, but there is no difference.
    assert code == INCONCLUSIVE and policy["differing_episodes"] == 0, found["reasons"]
    assert policy["largest_action_difference"] < 1e-4 and policy["compared_steps"] > 40
    made = json.loads(file.read_text())
    decides = system not in ("lang_dt", "vae")
    assert (policy["compared_decisions"] > 0) == decides and (policy["compared_plan_vectors"] > 0) == (system == "vae")
    episode = made["instructions"][0]["episodes"][0]
    draws = system in ("vae", "lcsd", "skilldiffuser", "skilldiffuser-ddpm")
    assert ("noise_seed" in episode) == draws

    if draws:
        # Other noise is another episode: nothing but the seed tells.
        episode["noise_seed"] += 1
        file.write_text(json.dumps(made))
        code, found = verify(path, file)
        assert code == DIFFERENT and found["policy"]["differing_episodes"] == 1, found["reasons"]
        del episode["noise_seed"]
        file.write_text(json.dumps(made))
        command = [newest("lads-run"), "verify", "--model", path, "--reference", file]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == 2 and "the policy draws noise, and its episodes do not say from which seed" in done.stderr
