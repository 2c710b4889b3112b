"""A method as a chain of stages; what a stage finds is stored with hashes of what it was computed from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar, TypeVarTuple

from toile.diagnosis.stage_store import Result, StageStore

Inputs = TypeVarTuple("Inputs")
Output = TypeVar("Output")

Progress = Callable[[str, float], None]
"""Called with what is being done and the share that is done."""


@dataclass(frozen=True)
class PipelineStage(Generic[*Inputs, Output]):
    """One step of a method.

    Attributes:
        name: of the stage, in files as well.
        file: where its result is stored within the folder.
        doing: what it does, for whoever waits.
        share: of all work that is done when it begins.
        output: class of its result, a dataclass.
        compute: its result from those of earlier stages.
        made_from: fingerprints of everything else that it depends on, by name.
    """

    name: str
    file: str
    doing: str
    share: float
    output: type[Output]
    compute: Callable[[*Inputs], Output]
    made_from: Mapping[str, str] = field(default_factory=dict)


class Pipeline:
    """Runs stages, or reads their results where they were made from the same.

    Args:
        store: of the results.
        progress: called before every stage.
    """

    def __init__(self, store: StageStore, progress: Progress) -> None:
        self._store, self._progress = store, progress
        # By identity: the values are kept here, so nothing else can get their ids.
        self._results: dict[int, Result[Any]] = {}

    def run(self, stage: PipelineStage[*Inputs, Output], *inputs: *Inputs) -> Output:
        """The result of a stage.

        Args:
            stage: to run, or to read.
            inputs: what earlier stages of this pipeline have found; it is computed again where one of them
                was another one.

        Raises:
            ValueError: an input is no result of this pipeline.
        """
        self._progress(stage.doing, stage.share)
        before = [self._results.get(id(value)) for value in inputs]
        if None in before:
            raise ValueError(f"{stage.name}: an input is no result of an earlier stage")
        made_from = {**stage.made_from, **{r.stage: r.digest for r in before if r is not None}}
        result = self._store.result(
            stage.name, stage.file, stage.output, made_from, lambda: stage.compute(*inputs)
        )
        self._results[id(result.value)] = result
        return result.value
