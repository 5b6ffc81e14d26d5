"""Tests every system: its losses against values by hand, a few steps of training, and its bundle against its own networks over the whole
sequence."""

import copy
import math

import numpy as np
import pytest
import synthetic
import torch
from resuming import assert_same_weights, interrupt
from test_training import setting_for

from lads_exporter import bundle, config, contract as contracts, dataset, language, twin, whole
from lads_exporter.codebook import nearest
from lads_exporter.kinds import denoising
from lads_exporter.systems import averaging, cluster, folding, lisa, vae
from lads_exporter.training import Stage, Trainer

DIFFUSION = {"steps": 150, "batch": 64, "learning_rate": 1e-2, "warmup": 5, "final": 0.1, "weight_decay": 0.0}
SKILLDIFFUSER = {
    "kind": "skilldiffuser", "low_level_layers": 1, "option_gradient": "first", "width": 16, "multiples": [1, 2], "groups": 4, "inverse": 16, "schedule": 50,
    "dropout": 0.25, "guidance": 1.2, "temperature": 0.5, "clip": 3.0, "average": 0.8, "sampler": "ddim", "passes": 5, "diffusion": DIFFUSION,
}  # fmt: skip
VALUES = {
    "lang_dt": {"system": {"kind": "lang_dt"}},
    "lisa": {"system": {"kind": "lisa", "low_level_layers": 2, "option_gradient": "first"}},
    "vae": {"system": {"kind": "vae", "beta": 1e-3, "rule": "sample"}},
    "wo_cp": {"system": {"kind": "lads", "regressed": True}},
    "cluster": {"system": {"kind": "cluster", "points": 250, "perplexity": 15.0}},
    "lcsd": {"system": {"kind": "lcsd", "hidden": 24, "steps": 5, "language": 1.0, "average": 0.8}, "high_level": {"context_steps": 30}},
    "skilldiffuser": {"system": SKILLDIFFUSER, "high_level": {"context_steps": 30}},
    "skilldiffuser_ddpm": {"system": SKILLDIFFUSER | {"sampler": "ddpm", "schedule": 10, "passes": 10}, "high_level": {"context_steps": 30}},
}
STEPS = 60


def setting_of(name, **training):
    table, *beside = setting_for("joint", **training).tables
    table = config.layered(table, VALUES[name])
    table["encoder"]["kmeans_step"] = 15
    for stage in ("joint", "low_level", "high_level"):
        table["training"][stage]["steps"] = STEPS
    return config.from_tables(table, *beside, "test")


def trainer_of(folder, setting):
    path = folder / "tiny.safetensors"
    data = dataset.load(path if path.exists() else synthetic.write(path, setting), setting)
    encoded = language.encode(setting.config.language, [row["text"] for row in setting.instructions])
    return Trainer(setting, data, encoded, folder / "run", torch.device("cpu"), 0), encoded


class Trained:
    """A system after a few steps of each stage, its bundle, and what its twin does in an episode."""

    def __init__(self, name, folder):
        self.name, self.setting = name, setting_of(name)
        self.trainer, self.encoded = trainer_of(folder, self.setting)
        self.networks, self.curves = self.trainer.networks, {}
        for stage_name in self.trainer.system.stages(self.setting.config):
            stage = Stage(stage_name, self.trainer)
            self.curves[stage_name] = [stage.advance(step) for step in range(stage.settings.steps)]
            assert all(math.isfinite(value) for value in stage.validate().values())
            stage.finish()
        corpus = self.trainer.corpus
        self.raw = [(int(corpus.instruction[e]), corpus.observations[e, : corpus.lengths[e]] * corpus.std + corpus.mean) for e in range(len(corpus.lengths))]
        golden = ((instruction, rows.numpy()) for instruction, rows in self.raw)
        provenance = {"dataset_sha256": "", "seed": 0, "steps": {}}
        self.model = bundle.assemble(self.networks, self.setting, self.encoded, provenance, golden)
        self.contract = contracts.of(self.model)
        self.instruction, self.observations = self.raw[0]
        self.rollout = twin.open_loop(twin.Twin(self.model), self.instruction, {"observation": self.observations.numpy()})
        self.actions = torch.from_numpy(np.stack(self.rollout.actions))


@pytest.fixture(scope="module", params=list(VALUES))
def trained(request, tmp_path_factory):
    return Trained(request.param, tmp_path_factory.mktemp(request.param))


def mean(curve, name):
    return sum(row[name] for row in curve) / len(curve)


def test_a_few_steps_lower_the_losses(trained):
    watched = {"lang_dt": ["bc"], "lisa": ["bc"], "vae": ["bc"], "wo_cp": ["bc"], "cluster": ["bc", "ce"], "lcsd": ["noise", "language"]}
    for stage, curve in trained.curves.items():
        for name in watched.get(trained.name, ["noise"] if stage == "diffusion" else ["bc"]):
            if name in curve[0]:
                assert mean(curve[-8:], name) < 0.85 * mean(curve[:8], name), (stage, name)


@torch.no_grad()
def test_the_bundle_step_by_step_equals_the_networks_over_the_whole_sequence(trained):
    words = [torch.from_numpy(row.words) for row in trained.encoded.instructions]
    policy = whole.of_networks(trained.networks, trained.setting, trained.encoded, trained.contract, words)
    policy.start(trained.instruction, seed=0)  # the contract's
    largest = []
    for step, (seen, done) in enumerate(zip(trained.observations, trained.actions, strict=True)):
        largest.append(np.abs(policy.act(seen.numpy()) - done.numpy()).max())
        policy.actions[-1] = done
        assert not policy.plans or policy.plans[-1] == trained.rollout.selected[step]
    assert bool(policy.plans) == ("codebook" in trained.contract["family"]) and bool(policy.vectors) == (trained.name == "vae")
    assert max(largest) <= 1e-4
    # The first step has no cache and one plan at most: graph against PyTorch.
    assert largest[0] <= 1e-5
    if trained.name == "cluster":
        _goals_are_encoded_as_in_training(trained)


def _goals_are_encoded_as_in_training(trained):
    corpus, system = trained.trainer.corpus, trained.trainer.system
    segments = corpus.segments(torch.arange(4), torch.zeros(4, dtype=torch.long))
    encode = twin.Entry(trained.model, "trajectory_encoder/encode")
    for row in (segments.lengths == corpus.horizon).nonzero()[:, 0].tolist():
        raw = segments.observations[row] * corpus.std + corpus.mean
        found = encode(observations=raw[None].numpy()) if "actions" not in encode.inputs else encode(observations=raw[None].numpy(), actions=segments.executed[row][None].numpy())
        episode = int(segments.rows[row])
        assert int(found["index"][0]) == int(system.codes[episode, int(segments.starts[row])])


def test_a_resumed_diffusion_equals_an_uninterrupted_one(tmp_path):
    """Tests that the moving average and the options of the frozen high level come back."""
    setting = setting_of("skilldiffuser")
    setting.tables[0]["system"] = SKILLDIFFUSER | {"diffusion": DIFFUSION | {"steps": 40}}
    setting = config.from_tables(*setting.tables, "test")
    whole, _ = trainer_of(tmp_path, setting)
    assert whole.run(quiet=True)
    (tmp_path / "run").rename(tmp_path / "whole")
    part, _ = trainer_of(tmp_path, setting)
    interrupt(part, STEPS + 20)
    resumed, _ = trainer_of(tmp_path, setting)
    assert resumed.run(resume=True, quiet=True)
    assert_same_weights(whole, resumed)


# Losses by hand.


def test_divergence_of_gaussians_by_hand():
    q = torch.tensor([[1.0, 0.0, 0.0, math.log(2.0)]])  # means 1 and 0, deviations 1 and 2
    assert vae.divergence(q, None)[0].tolist() == pytest.approx([0.5, (4 - 1) / 2 - math.log(2)], abs=1e-6)
    p = torch.tensor([[3.0, 0.0, math.log(2.0), 0.0]])
    expected = torch.distributions.kl_divergence(torch.distributions.Normal(torch.tensor([1.0, 0.0]), torch.tensor([1.0, 2.0])), torch.distributions.Normal(torch.tensor([3.0, 0.0]), torch.tensor([2.0, 1.0])))
    assert torch.allclose(vae.divergence(q, p)[0], expected)
    assert vae.split(torch.tensor([0.0, 0.0, 9.0, -99.0]))[1].tolist() == [2.0, -10.0], "log deviations are limited"


def zero(module):
    for value in module.parameters():
        torch.nn.init.zeros_(value)


def test_lang_dt_loss_is_the_mean_over_real_steps(tmp_path):
    trainer, _ = trainer_of(tmp_path, setting_of("lang_dt"))
    corpus, head = trainer.corpus, trainer.networks.high_level.head
    zero(head)
    torch.nn.init.constant_(head.bias, 0.25)
    trainer.networks.eval()
    episodes = corpus.train[:5]
    rows = torch.cat([corpus.actions[e, : corpus.lengths[e]] for e in episodes])
    torch.testing.assert_close(trainer.system.actions(episodes), (rows - 0.25).square().mean())


def test_lisa_losses_by_hand(tmp_path):
    trainer, _ = trainer_of(tmp_path, setting_of("lisa"))
    corpus, networks = trainer.corpus, trainer.networks
    networks.eval()
    zero(networks.low_level.head)
    networks.codebook.codes.copy_(torch.randn(networks.codebook.codes.shape))
    networks.codebook.started.fill_(True)
    episodes = corpus.train[:5]
    parts, index = trainer.system.chunks(episodes)
    rows = torch.cat([corpus.actions[e, : corpus.lengths[e]] for e in episodes])
    torch.testing.assert_close(parts["bc"], rows.square().mean())
    assert len(index) == sum(-(-int(n) // corpus.horizon) for n in corpus.lengths[episodes]), "an option for each chunk, none for padding"
    trainer.system.autocast = False
    latents = torch.cat([
        networks.project_in(networks.high_level([corpus.words[corpus.instruction[e]]], corpus.observations[e, : corpus.lengths[e]][None])[0, :: corpus.horizon])
        for e in episodes
    ])  # fmt: skip
    parts, index = trainer.system.chunks(episodes)
    assert sorted(index.tolist()) == sorted(nearest(latents, networks.codebook.codes).tolist())
    expected = 0.25 * (latents - networks.codebook.codes[nearest(latents, networks.codebook.codes)]).square().mean()
    torch.testing.assert_close(parts["commitment"], expected, rtol=1e-3, atol=1e-6)


def test_only_the_first_copy_of_an_option_carries_its_gradient():
    for gradient, expected in (("first", 1.0), ("all", 4.0)):
        option = torch.ones(2, 3, requires_grad=True)
        lisa.copies(option, 4, gradient).sum().backward()
        assert torch.equal(option.grad, torch.full((2, 3), expected))


def test_chunks_begin_at_the_start_of_the_context():
    places = torch.tensor([[0, 1, 2, 3, 4], [5, 6, -1, -1, -1]])
    values = torch.arange(10.0).view(2, 5, 1)
    chunks = lisa.Chunks(places, values, values, 2)
    assert chunks.kept.tolist() == [[True, True, True], [True, False, False]]
    assert chunks.places.tolist() == [[0, 1], [2, 3], [4, -1], [5, 6]]
    assert chunks.starts.tolist() == [0, 2, 4, 0]
    assert chunks.observations[..., 0].tolist() == [[0, 1], [2, 3], [4, 0], [5, 6]]


@torch.no_grad()
def test_folded_head_picks_the_nearest_code():
    torch.manual_seed(0)
    head, project, codes = torch.nn.Linear(12, 12), torch.nn.Linear(12, 4), torch.randn(9, 4)
    x = torch.randn(500, 12)
    assert torch.equal(folding.fold(head, project, codes)(x).argmax(-1), nearest(project(head(x)), codes))
    codes = torch.randn(9, 12)
    logits = folding.fold(head, None, codes)(x)
    assert torch.equal(logits.argmax(-1), nearest(head(x), codes))
    # A margin is the difference of the squared distances, in units of the codes' spread.
    distance = torch.cdist(head(x), codes).square() / (codes - codes.mean(0)).square().sum(1).mean()
    torch.testing.assert_close(logits[:, 3] - logits[:, 5], distance[:, 5] - distance[:, 3], rtol=1e-3, atol=1e-4)


@torch.no_grad()
def test_without_cp_the_loss_is_the_squared_distance_to_the_code(tmp_path):
    trainer, _ = trainer_of(tmp_path, setting_of("wo_cp"))
    networks, corpus = trainer.networks, trainer.corpus
    networks.eval()
    zero(networks.high_level.head)
    codes = torch.full((2, corpus.steps), -1)
    codes[0, 0], codes[1, 3] = 2, 4
    loss, _ = trainer.system.high_level(corpus.train[:2], codes)
    torch.testing.assert_close(loss, networks.codebook.codes[[2, 4]].square().mean())


@torch.no_grad()
def test_lcsd_losses_by_hand(tmp_path):
    trainer, _ = trainer_of(tmp_path, setting_of("lcsd"))
    networks, system, corpus = trainer.networks, trainer.system, trainer.corpus
    networks.eval()
    zero(networks.average.last)
    zero(networks.reconstruct[-1])
    episodes = corpus.train[:4]
    torch.manual_seed(3)
    count = int(corpus.lengths[episodes].sum())
    eps = torch.randn(count, corpus.actions.shape[2])
    torch.manual_seed(3)
    parts, index = system.parts_of(episodes, torch.ones(count, dtype=torch.long))
    torch.testing.assert_close(parts["noise"], eps.square().mean())  # a denoiser that says 0 misses all of the noise
    assert len(index) == count, "a plan at every step"
    assert float(parts["language"]) == pytest.approx(1.0), "nothing against a sentence of length 1"


def test_noise_schedule():
    bar = denoising.alpha_bar(200)
    f = lambda u: math.cos(math.pi / 2 * (u + 0.008) / 1.008) ** 2
    assert bar[0] == 1 and bar[100] == pytest.approx(f(0.5) / f(0)) and bar[200] < 1e-6
    assert denoising.passes("ddim", 200, 10) == [191, 172, 153, 134, 115, 96, 77, 58, 39, 20]
    assert denoising.passes("ddpm", 4, 4) == [4, 3, 2, 1]
    # With the true noise at hand, one pass of either sampler gives the clean value's share back.
    x0, eps = 0.3, -0.8
    for table in (denoising.ddim(200, 10), denoising.ddpm(200)):
        k = 191 if "eps_back" in table else 150
        row = {name: float(rows[0 if k == 191 else 50, 0]) for name, rows in table.items()}
        x = bar[k] ** 0.5 * x0 + (1 - bar[k]) ** 0.5 * eps
        assert row["x_scale"] * x + row["eps_scale"] * eps == pytest.approx(x0, abs=1e-4)
    assert row["x0_share"] * x0 + row["x_share"] * x == pytest.approx(_posterior_mean(bar, 150, x, x0), abs=1e-6)


def _posterior_mean(bar, k, x, x0):
    """Computes the mean of q(x_{k-1} | x_k, x_0) by Bayes' rule for the two Gaussians."""
    alpha = bar[k] / bar[k - 1]
    precision = 1 / (1 - bar[k - 1]) + alpha / (1 - alpha)
    return (bar[k - 1] ** 0.5 * x0 / (1 - bar[k - 1]) + alpha**0.5 * x / (1 - alpha)) / precision


@torch.no_grad()
def test_the_first_row_of_a_chunk_carries_no_noise_and_no_loss(tmp_path, monkeypatch):
    trainer, _ = trainer_of(tmp_path, setting_of("skilldiffuser"))
    stage = Stage("diffusion", trainer)
    networks, system = trainer.networks, stage.system
    networks.eval()
    seen = {}
    monkeypatch.setattr(networks.average, "forward", lambda x, told: seen.setdefault("x", x) * 0)
    torch.manual_seed(5)
    places = system.windows[:6]
    rows = networks.embedded(trainer.corpus.observations.flatten(0, 1)[places[:, None] + torch.arange(4)])
    eps = torch.randn_like(rows)
    torch.manual_seed(5)
    parts = system.diffusion(places, torch.full((6,), 50))
    assert torch.equal(seen["x"][:, 0], rows[:, 0]) and not torch.allclose(seen["x"][:, 1], rows[:, 1])
    torch.testing.assert_close(parts["noise"], eps[:, 1:].square().mean())
    steps = trainer.corpus.lengths[trainer.corpus.train]
    assert len(system.windows) == int((steps - 3).sum()), "every window of real steps"


def test_moving_average():
    slow, fast = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1)
    torch.nn.init.zeros_(slow.weight)
    torch.nn.init.ones_(fast.weight)
    for _ in range(2):
        averaging.follow(slow, fast, 0.9)
    assert float(slow.weight) == pytest.approx(0.19)


def test_goals_are_real_observations_in_the_middle_of_their_clusters():
    torch.manual_seed(0)
    centres = 20 * torch.eye(3, 5)
    points = torch.cat([centre + 0.5 * torch.randn(40, 5) for centre in centres])
    chosen = cluster.medoids(points, 3, 10.0, 1)
    assert sorted((chosen // 40).tolist()) == [0, 1, 2]
    assert torch.equal(cluster.medoids(points, 3, 10.0, 1), chosen)


def test_a_goal_is_the_last_observation_of_the_segment(tmp_path):
    trainer, _ = trainer_of(tmp_path, setting_of("cluster"))
    corpus = trainer.corpus
    length = int(corpus.lengths[0])
    ends = trainer.system._ends(torch.tensor([0, 0]), torch.tensor([0, length - 2]))
    assert torch.equal(ends, corpus.observations[0, [corpus.horizon - 1, length - 1]])


def test_a_system_layer_replaces_the_system_and_only_values_that_are_there():
    table = config.layered({"a": {"x": 1, "y": 2}, "system": {"kind": "lads", "regressed": False}}, {"a": {"x": 3}, "system": {"kind": "lang_dt"}})
    assert table == {"a": {"x": 3, "y": 2}, "system": {"kind": "lang_dt"}}
    tables = copy.deepcopy(setting_of("lisa").tables)
    for change, named in (({"kind": "nonsense"}, "unknown system; known: lads, vae"), ({"kind": "lisa"}, "low_level_layers"), ({"kind": "lang_dt", "beta": 1.0}, "unknown key 'beta'")):
        with pytest.raises(config.UserError, match=named):
            config.from_tables(tables[0] | {"system": change}, *tables[1:], "test")


@pytest.mark.parametrize("environment", ["lorel", "kitchen", "lorel-image"])
def test_every_system_that_ships_has_a_sound_configuration(environment):
    folder = config.find(f"configs/{environment}.toml").resolve().parent
    for base in (f"{environment}.toml", f"{environment}-paper.toml")[: 1 + (environment != "lorel-image")]:
        for path in sorted((folder / environment).glob("*.toml")):
            assert config.load(folder / base, path).config.period >= 1
