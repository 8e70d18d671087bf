"""Candidates verified in truer dynamics than the planner's own, whose results correct the search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from larp_model.errors import InputError
from mpc.dynamics import Dynamics
from mpc.search import Enough, Optimizer, Problem, Residuals, Search, distinct, merged, require_enough, suffices


class Trial(NamedTuple):
    """A candidate tried in the truer dynamics: knots (K, J, 3) [rad], its cost and its residuals (1, ...) there."""

    knots: np.ndarray
    cost: float
    residuals: Residuals


@dataclass(frozen=True)
class Verified:
    """The planner's own dynamics propose, truer ones decide, and their verdict corrects the next proposal.

    Each round tries the best candidates in `dynamics`. Between two rounds `optimizer` searches on in the planner's own
    dynamics, whose residuals are moved to where they are right for the best candidate so far, theta*:

        r(theta) = r_model(theta) + r_true(theta*) - r_model(theta*)

    So a model that errs much alike for neighbouring candidates finds a plan that is good in truth after a few trials,
    as an archer corrects the aim by the last miss. Where proposals turn out worse, half of the way to them is tried
    next. With `GaussNewton` as the optimizer a round is a step by the truth's residual and the model's Jacobian, and
    one candidate suffices (model management: N. Alexandrov and R. Lewis, "An Overview of First-Order Model Management
    for Engineering Optimization", 2001).
    """

    settles: ClassVar[bool] = True

    dynamics: Dynamics
    optimizer: Optimizer
    rounds: int = 3
    """Trials of candidates, at most; one only ranks what was found."""
    candidates: int = 8
    """Tried in each round, none twice; in the first the plan carried on too, so that none replaces a better one."""
    enough: Enough = ()
    """What ends the trials, in truth."""

    def __post_init__(self) -> None:
        for name, least in {"rounds": 1, "candidates": 1}.items():
            if getattr(self, name) < least:
                raise InputError(f"{name}: got {getattr(self, name)}, needs at least {least}")
        require_enough(self.enough)

    @property
    def differentiates(self) -> bool:
        """Return whether its optimizer needs gradients."""
        return self.optimizer.differentiates

    @property
    def elites(self) -> int:
        """Return how many of the best candidates it needs."""
        return max(self.candidates, self.optimizer.elites)

    def improve(self, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """Return the search after all rounds, or once the cheapest trial is `enough`.

        The elites are ranked by the truer dynamics.
        """
        tried: list[Trial] = []
        proposed = np.concatenate([search.elites[:1], problem.carried[None], search.elites[1:]])
        for index in range(self.rounds):
            knots = untried(proposed, tried)[: self.candidates if tried else max(2, self.candidates)]
            if not len(knots):
                break
            found = problem.trials(self.dynamics, knots)
            for row, each in enumerate(knots):
                tried.append(Trial(each, float(found.costs[row]), found.row(row).residuals))
            best = min(tried, key=lambda trial: trial.cost)
            if index == self.rounds - 1 or suffices(self.enough, best.cost, best.residuals):
                break
            if index and not any(best is trial for trial in tried[-len(knots) :]) and np.isfinite(best.cost):
                proposed = 0.5 * (best.knots + knots)
                continue
            inner = self.corrected(best, problem)
            elites = np.concatenate([best.knots[None], search.elites[:-1]])
            search = search._replace(mean=best.knots, elites=elites, costs=np.full(len(elites), np.inf, np.float32))
            search = self.optimizer.improve(search, random, inner)
            proposed = search.elites[np.isfinite(search.costs)]
        # What the planner's own dynamics said counts no more; where no trial is finite, the plan carried on stays.
        elites = np.concatenate([problem.carried[None], search.elites[:-1]])
        search = search._replace(elites=elites, costs=np.full(len(elites), np.inf, np.float32))
        return merged(
            search, np.stack([each.knots for each in tried]), np.array([each.cost for each in tried], np.float32)
        )

    @staticmethod
    def corrected(best: Trial, problem: Problem) -> Problem:
        """Return the problem with residuals right for the best candidate.

        It is the same one where the candidate is lost in the planner's own dynamics, or in the truer ones.
        """
        if not np.isfinite(best.cost):
            return problem
        believed = problem.tries(best.knots[None])
        if not np.isfinite(believed.costs[0]):
            return problem
        return problem.corrected({name: true - believed.residuals[name] for name, true in best.residuals.items()})


def untried(knots: np.ndarray, tried: list[Trial]) -> np.ndarray:
    """Return the knots (N, K, J, 3) that were not tried yet, in their order, each once."""
    known = {trial.knots.tobytes() for trial in tried}
    return knots[[row for row in distinct(knots) if knots[row].tobytes() not in known]]
