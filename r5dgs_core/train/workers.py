"""Processes that train one run together (`torch.distributed`): each draws a part of the views of a step.

All processes have the same state and draw the same random numbers, so they make the same decisions. Gradients are
summed over the processes, and other results of the views are gathered. The first process leads: only it writes files
and computes the gradients of penalties, which do not depend on a view.
"""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Iterator, Sequence
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch._C._distributed_c10d import PrefixStore, Store, TCPStore
from torch.distributed.rendezvous import rendezvous

from ..errors import ConfigError, Interrupted, TrainingError

Item = TypeVar("Item")

# Others wait while the leading process searches for objects; broken connections end at once.
LONGEST = timedelta(days=1)
ATTEMPT = timedelta(seconds=3)
LEADER = "r5dgs.leader"  # key of the port of the leading process


class Workers:
    """The processes of a run; by default, this process is alone.

    Args:
        rank: Index of this process.
        count: Number of processes.
        store: Memory that the processes share; None if there is one process.
    """

    def __init__(self, rank: int = 0, count: int = 1, store: Store | None = None):
        self.rank, self.count, self._store = rank, count, store

    @property
    def leads(self) -> bool:
        """True if this process writes the files of the run."""
        return self.rank == 0

    def check_batch(self, views: int) -> None:
        """Raise `ConfigError` if the processes cannot share the views of a step equally."""
        if views % self.count:
            raise ConfigError(
                f"train.batch: {self.count} processes cannot share {views} view{'s' * (views != 1)} per step equally. "
                f"Remedy: --set train.batch={self.count} for a new run, or another number of processes"
            )

    def share(self, items: Sequence[Item]) -> list[Item]:
        """Return the items that this process works on."""
        return list(items[self.rank :: self.count])

    def gather(self, items: Sequence[Item]) -> list[Item]:
        """Return the results of all processes in the order of the items that `share` divided."""
        if self.count == 1:
            return list(items)
        found: list[Any] = [None] * self.count
        with _together():
            dist.all_gather_object(found, list(items))
        return [found[k % self.count][k // self.count] for k in range(sum(map(len, found)))]

    def add_gradients(self, parameters: Sequence[torch.Tensor]) -> None:
        """Replace the gradients of parameters by their sums over all processes; some may have none in a process."""
        if self.count == 1:
            return
        given = torch.tensor([p.grad is not None for p in parameters], dtype=torch.int32)
        with _together():
            dist.all_reduce(given)
            trained = [p for p, number in zip(parameters, given.tolist(), strict=True) if number]
            parts = [(torch.zeros_like(p) if p.grad is None else p.grad).reshape(-1) for p in trained]
            total = torch.cat(parts)
            dist.all_reduce(total)
        for parameter, part in zip(trained, total.split([p.numel() for p in trained]), strict=True):
            parameter.grad = part.view_as(parameter).clone()

    def of_leader(
        self, parameters: Sequence[torch.Tensor], gradients: Sequence[torch.Tensor | None]
    ) -> list[torch.Tensor | None]:
        """Return the gradients that the leading process passes, None for parameters without; others are ignored."""
        if self.count == 1:
            return list(gradients)
        given = torch.tensor([gradient is not None for gradient in gradients], dtype=torch.int32)
        with _together():
            dist.broadcast(given, 0)
            changed = [p for p, number in zip(parameters, given.tolist(), strict=True) if number]
            if not changed:
                return [None] * len(gradients)
            sizes = [p.numel() for p in changed]
            flat = changed[0].new_empty(sum(sizes))
            if self.leads:
                flat = torch.cat([gradient.reshape(-1) for gradient in gradients if gradient is not None])
            dist.broadcast(flat, 0)
        parts = iter(flat.split(sizes))
        return [next(parts).view_as(p) if n else None for p, n in zip(parameters, given.tolist(), strict=True)]

    def any(self, flag: bool) -> bool:
        """Return True if the flag is set in any process."""
        if self.count == 1:
            return flag
        total = torch.tensor(int(flag))
        with _together():
            dist.all_reduce(total)
        return bool(total)

    def broadcast(self, value: Any) -> Any:
        """Return the value of the leading process."""
        if self.count == 1:
            return value
        found = [value]
        with _together():
            dist.broadcast_object_list(found)
        return found[0]

    def explains(self, error: BaseException) -> bool:
        """Return True if this process reports an error that ends the run; the others stay silent.

        The leading process reports interruptions, and the first process that fails reports its error.
        """
        if self._store is None or isinstance(error, Interrupted | KeyboardInterrupt):
            return self.leads
        try:
            return self._store.add("failures", 1) == 1
        except RuntimeError:  # the program that started the processes has ended
            return self.leads


ALONE = Workers()


@contextlib.contextmanager
def joined() -> Iterator[Workers]:
    """Join the processes that ``torch.distributed.run`` has started with this one."""
    # Import this before the group exists. Its default arguments would otherwise keep the group, whose threads can abort
    # the process at exit.
    import torch.distributed.nn.functional  # noqa: F401

    with _together():
        shared, rank, count = next(rendezvous("env://", timeout=LONGEST))
        store, reports = _meet(shared, rank)
        uses_gpus = torch.cuda.is_available() and dist.is_nccl_available()
        backend = "cpu:gloo,cuda:nccl" if uses_gpus else "gloo"
        dist.init_process_group(backend, timeout=LONGEST, store=store, rank=rank, world_size=count)
    yield Workers(rank, count, reports)
    dist.destroy_process_group()  # after an error, others may be gone and would be waited for


def _meet(shared: Store, rank: int) -> tuple[Store, Store]:
    """Return a new store in the leading process, and a part of a shared store which outlives that process.

    The shared store still has the keys of processes that were ended and restarted, such as their addresses.
    """
    host = os.environ["MASTER_ADDR"]
    if rank == 0:
        store = TCPStore(host, 0, is_master=True, wait_for_workers=False, timeout=LONGEST)
        shared.set(LEADER, str(store.port))
        return store, PrefixStore(str(store.port), shared)
    while True:
        port = int(shared.get(LEADER))
        try:
            store = TCPStore(host, port, is_master=False, timeout=ATTEMPT)
        except RuntimeError:  # the port of a leading process that has ended
            continue
        store.set_timeout(LONGEST)
        return store, PrefixStore(str(port), shared)


def on_this_machine() -> int:
    """Return the number of processes of this run on this machine."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", "1"))


def may_restart() -> bool:
    """Return True if ``torch.distributed.run`` starts the processes again after one of them has ended."""
    return int(os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0")) > 0


def launch_command(count: int, arguments: Sequence[str]) -> str:
    """Return the command that starts ``r5dgs`` with these arguments in ``count`` processes, as many as now."""
    if count == 1:
        return shlex.join(["r5dgs", *arguments])
    machines = int(os.environ.get("GROUP_WORLD_SIZE", "1"))
    several = ["--nnodes", str(machines), "--rdzv-backend", "c10d", "--rdzv-endpoint", "HOST:PORT"] * (machines > 1)
    started = ["torchrun", *several, "--nproc-per-node", str(on_this_machine())]
    return shlex.join([*started, "-m", "r5dgs_core", *arguments])


@contextlib.contextmanager
def _together() -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        reason = str(error).splitlines()[0].split(". ")[0].split("] ")[-1]
        raise TrainingError(
            f"another process of this run has ended or cannot be reached ({reason}); the last checkpoint is kept. "
            "Remedy: look for messages of the other processes, and repeat the command with --resume"
        ) from error
