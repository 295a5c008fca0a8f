"""Runs that are known, and made again all the same, for the weights that they have left elsewhere.

Curves and scores are small and travel with the repository; policies and discriminators stay where
they were made.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

from deploy.reproduce.experiment import Experiment
from deploy.reproduce.runs import FinishedRun, RunKey, iterations_of
from deploy.reproduce.stored_scores import StoredScore, unscored
from deploy.reproduce.work_folder import discriminators_file, policy_file


def runs_to_repeat(
    experiment: Experiment,
    finished: Iterable[FinishedRun],
    scores: Sequence[StoredScore],
    work: Path,
) -> set[RunKey]:
    """Runs of which something is still to be made that needs weights which are not there.

    Args:
        experiment: Scores last policies, or draws what discriminators reward, or does neither.
        finished: Runs whose curves are known.
        scores: That are known.
        work: Folder in which the experiment's runs leave their weights.

    Raises:
        PresetError: There are no such stored states.
    """
    known = {run.key: run.iterations for run in finished}
    to_score = itertools.chain(*unscored(experiment, scores, work).values())
    lost = {
        plan.key
        for plan in to_score
        if known.get(plan.key, -1) >= iterations_of(plan, None)
        and not policy_file(work, plan).exists()
    }
    if experiment.has_reward_maps:
        lost |= {
            plan.key
            for plan in experiment.plans()
            if not discriminators_file(work, plan, known.get(plan.key, 0)).exists()
        }
    return lost
