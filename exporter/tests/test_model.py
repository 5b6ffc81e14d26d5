"""Tests codebook and networks: start and revival of codes, masks and padding, the contrastive loss."""

import dataclasses

import pytest
import torch

from lads_exporter import config
from lads_exporter.codebook import Codebook, kmeans, nearest, perplexity
from lads_exporter.model import Alignment, Dropout, HighLevelPolicy, TrajectoryEncoder, attend


@pytest.fixture(scope="module")
def setting():
    return config.load("configs/tiny.toml").config


def clusters(count, each, dim=4, spread=0.05, seed=0):
    generator = torch.Generator().manual_seed(seed)
    centres = 3 * torch.randn(count, dim, generator=generator)
    points = centres.repeat_interleave(each, 0)
    return centres, points + spread * torch.randn(points.shape, generator=generator)


def test_kmeans_finds_the_clusters():
    torch.manual_seed(0)
    centres, points = clusters(5, 40)
    found, members = kmeans(points, 5)
    assert torch.cdist(centres, found).min(1).values.max() < 0.1
    assert members.tolist() == [40] * 5


def test_codes_follow_the_moving_average(setting):
    torch.manual_seed(0)
    book = Codebook(setting.encoder).train()
    _, points = clusters(5, 40)
    book.start(points)
    before = book.codes.clone()
    moved = points + 0.2
    for _ in range(5):
        book(moved)
    after = book.codes
    target = before + 0.2
    share = 1 - setting.encoder.ema**5
    uses = setting.encoder.ema**5 * 40 / (setting.encoder.ema**5 * 40 + share * 40)
    assert torch.allclose(after, uses * before + (1 - uses) * target, atol=1e-4)
    book.eval()
    book(points)
    assert torch.equal(after, book.codes), "evaluation must not move the codes"


def test_dead_codes_are_revived(setting):
    torch.manual_seed(0)
    book = Codebook(setting.encoder).train()
    _, points = clusters(5, 40)
    book.start(points)
    with torch.no_grad():
        book.codes[2] = 100.0
        book.sums[2] = 100.0 * book.uses[2]
    for _ in range(400):
        book(points)
    assert int(book.revived) >= 1
    assert perplexity(nearest(points, book.codes), 5) > 3


def test_straight_through_and_commitment(setting):
    torch.manual_seed(0)
    book = Codebook(setting.encoder).eval()
    latents = torch.randn(7, 4, requires_grad=True)
    plans, index, commitment = book(latents)
    assert plans is latents and commitment == 0, "no quantisation before the start"
    book.start(torch.randn(50, 4))
    plans, index, commitment = book(latents)
    assert torch.allclose(plans, book.codes[index], atol=1e-6)
    plans.sum().backward(retain_graph=True)
    assert torch.equal(latents.grad, torch.ones_like(latents))
    expected = setting.encoder.commitment * (latents - book.codes[index]).square().mean()
    assert torch.allclose(commitment, expected)


@torch.no_grad()
def test_encoder_ignores_what_lies_beyond_a_short_segment():
    torch.manual_seed(0)
    encoder = TrajectoryEncoder(16, 5, 3, 4, 5, False)
    observations, actions = torch.randn(2, 6, 5), torch.randn(2, 6, 3)
    lengths = torch.tensor([6, 4])
    full = encoder(observations, actions, lengths)
    observations[1, 4:], actions[1, 4:] = 1e3, -1e3
    assert torch.equal(full, encoder(observations, actions, lengths))
    alone = encoder(observations[1:, :4], actions[1:, :4], torch.tensor([4]))
    assert torch.allclose(full[1:], alone, atol=1e-6)


@torch.no_grad()
def test_encoder_folded_inputs_equal_the_unfolded_networks():
    torch.manual_seed(0)
    encoder = TrajectoryEncoder(16, 5, 3, 4, 5, False)
    observations, actions = torch.randn(2, 6, 5), torch.randn(2, 6, 3)
    joined = torch.cat([encoder.embed_observation(observations), encoder.embed_action(actions)], -1)
    expected = encoder.mlp(encoder.lstm(joined)[0][:, -1])
    assert torch.allclose(encoder(observations, actions, torch.tensor([6, 6])), expected, atol=1e-5)


def high_level(setting, heads=2, **changes):
    torch.manual_seed(0)
    policy = HighLevelPolicy(dataclasses.replace(setting.high_level, context_steps=60, heads=heads, **changes), 8, 5, 3, 5)
    for value in policy.parameters():
        torch.nn.init.normal_(value, std=0.3)
    return policy.eval()


@torch.no_grad()
@pytest.mark.parametrize("steps", [1, 2, 5, 24, 60])
@pytest.mark.parametrize("lengths", [(3, 3), (9, 2), (1, 30)])
def test_padding_in_a_batch_changes_nothing(setting, steps, lengths):
    policy = high_level(setting)
    words = [torch.randn(length, 8) for length in lengths]
    observations, actions = torch.randn(2, steps, 5), torch.randn(2, steps, 3)
    together = policy(words, observations, actions)
    for row in range(2):
        alone = policy(words[row : row + 1], observations[row : row + 1], actions[row : row + 1])
        assert torch.allclose(together[row : row + 1], alone, atol=2e-5)


@torch.no_grad()
def test_logits_depend_on_the_past_only(setting):
    policy = high_level(setting)
    words = [torch.randn(3, 8)]
    observations, actions = torch.randn(1, 20, 5), torch.randn(1, 20, 3)
    before = policy(words, observations, actions)
    observations[:, 12:], actions[:, 11:] = 5.0, 5.0  # s_12 and a_11 come after s_11
    after = policy(words, observations, actions)
    assert torch.equal(before[:, :12], after[:, :12])
    assert (before[:, 12:] - after[:, 12:]).abs().max() > 1e-2
    actions[:, 3] += 1.0
    assert (policy(words, observations, actions)[:, 5] - after[:, 5]).abs().max() > 1e-3, "actions must be seen"


@pytest.mark.parametrize(("rows", "step", "prefix"), [(50, 1, 0), (1, 1, 0), (33, 2, 9), (5, 2, 30), (1, 2, 4)])
def test_attention_in_blocks_equals_the_fused_operator(rows, step, prefix):
    """Tests values and gradients; the fused operator is what a GPU runs."""
    torch.manual_seed(0)
    keys = prefix + (rows - 1) * step + 1
    q, k, v = (torch.randn(2, 2, size, 8, requires_grad=True) for size in (rows, keys, keys))
    own = prefix + step * torch.arange(rows)
    mask = torch.where(torch.arange(keys) > own[:, None], -1e4, 0.0).expand(2, 1, -1, -1)
    outputs = attend(q, k, v, mask, step), torch.nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    assert torch.allclose(*outputs, atol=1e-5)
    gradients = [torch.autograd.grad(out.square().sum(), (q, k, v)) for out in outputs]
    assert all(torch.allclose(a, b, atol=1e-4) for a, b in zip(*gradients))


def test_dropout_keeps_the_mean_and_the_rate():
    torch.manual_seed(0)
    drop, x = Dropout(0.1), torch.ones(1000, 1001)
    out = drop(x)
    assert (out == 0).float().mean().item() == pytest.approx(26 / 256, abs=2e-3)
    assert out.mean().item() == pytest.approx(1, abs=2e-3)
    assert drop.eval()(x) is x


def test_same_instruction_is_no_negative(setting):
    torch.manual_seed(0)
    align = Alignment(setting.alignment, 4, 8).eval()
    plans, valid, sentences = torch.randn(3, 6, 4), torch.ones(3, 6, dtype=torch.bool), torch.randn(3, 8)
    same, different = torch.tensor([0, 0, 0]), torch.tensor([0, 1, 2])
    assert align(plans, valid, sentences, same).item() == pytest.approx(0.0, abs=1e-6)
    assert align(plans, valid, sentences, different).item() > 0.01
    masked = valid.clone()
    masked[1, 4:] = False
    first = align(plans, masked, sentences, different)
    plans[1, 4:] = 50.0
    assert torch.allclose(first, align(plans, masked, sentences, different), atol=1e-5)


@torch.no_grad()
def test_encoder_sees_what_it_is_shown_only():
    torch.manual_seed(0)
    encoder = TrajectoryEncoder(16, 5, 3, 4, 2, False)
    observations, actions, lengths = torch.randn(6, 7, 5), torch.randn(6, 7, 3), torch.full((6,), 7)
    before = encoder(observations, actions, lengths)
    observations[:, :, 2:] = 9.0
    assert torch.equal(before, encoder(observations, actions, lengths))
    observations[:, :, 1] += 1.0
    assert (before - encoder(observations, actions, lengths)).abs().max() > 1e-3


def test_segment_dropout_leaves_out_its_share_and_never_all(setting):
    torch.manual_seed(0)
    align = Alignment(dataclasses.replace(setting.alignment, segment_dropout=0.7), 4, 8)
    valid = torch.arange(20) < torch.randint(1, 21, (2000,))[:, None]
    kept = align.some(valid)
    assert not (kept & ~valid).any()
    assert kept.any(1).all()
    full = valid.all(1)
    assert kept[full].float().mean().item() == pytest.approx(0.3, abs=0.03)


def test_perplexity():
    assert perplexity(torch.arange(8), 8) == pytest.approx(8)
    assert perplexity(torch.zeros(8, dtype=torch.long), 8) == pytest.approx(1)
