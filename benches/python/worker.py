"""Runs a contender in a process of its own, which keeps to the protocol of the benchmark and measures itself.

One JSON object per line in, one per line out. Deadlines are absolute. Anything that fails is a line with the key "error".
"""

import json
import os
import sys
import time


def load(path):
    import onnx

    model = onnx.load(path)
    contract = json.loads(next(entry.value for entry in model.metadata_props if entry.key == "lads.contract"))
    return model, contract


class Worker:
    def __init__(self, name, bundle, episode):
        from contenders import policies

        model, contract = load(bundle)
        self.horizon = contract["family"]["horizon"]
        self.policy = policies()[name](model, contract, episode["instruction"])
        self.observations = [self.policy.tensor(row) for row in episode["observations"]]
        self.rows = episode["observations"]
        self.walked = []  # per control step: tokens before it, the action and the plan before it

    def observation(self, step):
        return self.observations[step % len(self.observations)]

    def walk(self, steps):
        """Runs the first steps -> plans, actions."""
        policy = self.policy
        policy.frozen = False
        policy.instruct()
        self.walked, plans, actions = [], [], []
        action = plan = index = None
        for step in range(steps):
            self.walked.append((policy.tokens(), action, plan))
            action, plan, new = policy.step(self.observation(step), action, step, plan, step % self.horizon == 0)
            index = index if new is None else new
            plans.append(index)
            actions.append(policy.numbers(action))
        return plans, actions

    def call(self, work, first, middle):
        """Returns the function to time, given the number of the call; it returns the kind of call."""
        policy = self.policy
        if work == "instruct":
            return lambda number: (policy.instruct(), "instruct")[1]
        if work == "recompute":
            _, actions = self.walk(middle + 1)
            rows = [self.rows[step % len(self.rows)] for step in range(middle + 1)]
            whole = policy.recompute(rows, actions[:-1])
            return lambda number: (whole(), "recompute")[1]
        if len(self.walked) <= middle:
            self.walk(middle + 1)
        tokens, before, plan = self.walked[middle]
        if work == "act":
            return lambda number: (policy.numbers(policy.act(self.observation(number), plan)), "act")[1]

        def step(number):
            policy.at(tokens)
            decides = (first + number) % self.horizon == 0
            action, _, _ = policy.step(self.observation(middle), before, middle, plan, decides)
            policy.numbers(action)
            return "decision" if decides else "ordinary"

        return step

    def block(self, work, first, middle, calls, settle, period):
        call = self.call(work, first - settle, max(middle, 1))
        samples, due = [], time.monotonic_ns()
        for number in range(settle + calls):
            late = 0
            if period:
                due += period
                due += max(time.monotonic_ns() - due, 0) // period * period
                time.sleep(max(due - time.monotonic_ns(), 0) / 1e9)
                late = max(time.monotonic_ns() - due, 0)
            start = time.monotonic_ns()
            kind = call(number)
            took = time.monotonic_ns() - start
            if number >= settle:
                samples.append([kind, late, took])
        return samples


def realtime(on):
    """Asks for SCHED_FIFO, like the other contenders; runs without it where it is not granted."""
    try:
        policy, priority = (os.SCHED_FIFO, 50) if on else (os.SCHED_OTHER, 0)
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except (OSError, AttributeError):
        pass


def answer(worker, request):
    if request["command"] == "replay":
        plans, actions = worker.walk(request["steps"])
        return {"plans": plans, "actions": actions}
    realtime(request["fifo"])
    keys = ("work", "first", "middle", "calls", "settle", "period")
    return {"samples": worker.block(*(request[key] for key in keys))}


def main():
    worker = None
    # What a library prints must not get between the answers.
    out, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        try:
            request = json.loads(line)
            if request["command"] == "open":
                worker = Worker(request["name"], request["bundle"], request["episode"])
                reply = {"detail": worker.policy.detail, "recompute": hasattr(worker.policy, "recompute")}
            else:
                reply = answer(worker, request)
        except Exception as error:  # whatever it is, the benchmark goes on without this contender
            reply = {"error": f"{type(error).__name__}: {error}".splitlines()[0]}
        out.write(json.dumps(reply) + "\n")
        out.flush()


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
