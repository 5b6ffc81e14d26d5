"""Interrupts a training, and compares what came of it with one that was not interrupted."""

import torch


def interrupt(trainer, at):
    """Runs a training that is interrupted in a step: its number among all steps, from 1, or (stage, step)."""
    loss, done = trainer.system.loss, 0

    def stopping(stage, step):
        nonlocal done
        done += 1
        trainer.stop = at in (done, (stage, step))
        return loss(stage, step)

    trainer.system.loss = stopping
    assert not trainer.run(quiet=True)


def assert_same_weights(one, other):
    for (name, a), b in zip(one.networks.state_dict().items(), other.networks.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
