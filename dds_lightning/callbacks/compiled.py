"""Compile the loss of a training."""

import shutil
from contextlib import AbstractContextManager, ExitStack, nullcontext
from typing import Any, Literal

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Callback

from dds_lightning.errors import UserError

COMPILERS = ("g++", "clang++", "c++")


def recomputed_masks() -> AbstractContextManager[Any]:
    """Code compiled in here computes ReLU's masks in the backward pass, where the compiler would keep them as booleans.

    Its code is slow to write booleans on a processor: a clone takes twice as many steps a second.
    """
    import torch._functorch.config as settings

    name = "ban_recompute_materialized_backward"
    return settings.patch({name: False}) if hasattr(settings, name) else nullcontext()


class CompiledLoss(Callback):
    """Compile the module's loss, forward and backward, with `torch.compile`; networks and checkpoints stay as they are.

    Operations between matrix products are fused, so rounding differs a little from a training without it. Worth it for
    small networks (`benchmarks/results/bench.md`), and made for GPUs, where mode ``reduce-overhead`` replays a step as
    CUDA graphs. The first step takes up to a minute.

    Args:
        mode: Of `torch.compile`; the last three take minutes to try out kernels, or need a GPU.
        backend: Of `torch.compile`: ``aot_eager`` needs no compiler and gains nothing, for tests.
    """

    def __init__(
        self,
        mode: Literal["default", "reduce-overhead", "max-autotune", "max-autotune-no-cudagraphs"] = "default",
        backend: Literal["inductor", "cudagraphs", "aot_eager"] = "inductor",
    ) -> None:
        self.mode, self.backend = mode, backend
        self._masks = ExitStack()

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Put the compiled loss before the module's own, which validation goes on using.

        Raises:
            UserError: There is no compiler for the processor's code.
        """
        own: Any = pl_module.loss
        on_cpu = trainer.strategy.root_device.type == "cpu"
        if self.backend == "inductor" and on_cpu and not any(map(shutil.which, COMPILERS)):
            raise UserError(
                "compiled loss: on a CPU it needs a C++ compiler (g++ or clang++), and none was found: install one, "
                "or train without this callback"
            )
        options: dict[str, Any] | None = None  # the other backends know none
        if self.backend == "inductor":
            # What torch draws for dropout is vectorised on a processor, and what the compiler would generate is not.
            options = {**torch._inductor.list_mode_options(self.mode), "fallback_random": on_cpu}
        compiled = torch.compile(own, backend=self.backend, options=options)

        def loss(batch: Any) -> Any:
            if not pl_module.training:
                return own(batch)
            torch.compiler.cudagraph_mark_step_begin()  # what the last step returned may be overwritten
            return compiled(batch)

        pl_module.loss = loss  # type: ignore[assignment]
        if on_cpu:  # until teardown: compiled at the first step, and again where shapes change
            self._masks.enter_context(recomputed_masks())

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Give the module its own loss back, and the compiler its settings."""
        pl_module.__dict__.pop("loss", None)
        self._masks.close()
