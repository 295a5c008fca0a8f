"""Runs that are known, and made again all the same, for the policies that they have left elsewhere.

Curves and scores are small and travel with the repository; weights stay where they were made.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path

from deploy.reproduce.experiment import Experiment
from deploy.reproduce.runs import FinishedRun, RunKey, iterations_of
from deploy.reproduce.stored_scores import StoredScore, unscored
from deploy.reproduce.work_folder import policy_file


def runs_to_repeat(
    experiment: Experiment,
    finished: Iterable[FinishedRun],
    scores: Iterable[StoredScore],
    work: Path,
) -> set[RunKey]:
    """Whole runs that are still to be scored on stored states, and whose policies are not there.

    Args:
        experiment: Whose runs.
        finished: Runs whose curves are known.
        scores: That are known.
        work: Folder in which the experiment's runs leave their policies.

    Raises:
        PresetError: There are no such states.
    """
    known = {run.key: run.iterations for run in finished}
    return {
        plan.key
        for plan in itertools.chain(*unscored(experiment, scores, work).values())
        if known.get(plan.key, -1) >= iterations_of(plan, None)
        and not policy_file(work, plan).exists()
    }
