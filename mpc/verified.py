"""Candidates verified in truer dynamics than the planner's own, whose results correct the search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from larp_model.errors import InputError
from mpc.dynamics import Dynamics
from mpc.search import Optimizer, Problem, Residuals, Search, Tolerance, converged, distinct, merged, require_tolerance


class Validation(NamedTuple):
    """A candidate evaluated in the truer dynamics: knots (K, J, 3) [rad], its cost and its residuals (1, ...) there."""

    knots: np.ndarray
    cost: float
    residuals: Residuals


@dataclass(frozen=True)
class Verified:
    """The planner's own dynamics propose, truer ones decide, and their results correct the next proposal.

    Each round evaluates the best candidates in `dynamics`. Between two rounds `optimizer` searches on in the planner's
    own dynamics, whose residuals are shifted to be right for the best candidate so far, theta*:

        r(theta) = r_model(theta) + r_true(theta*) - r_model(theta*)

    So a model that errs much alike for neighbouring candidates finds a plan that is good in the truer
    dynamics after a few rounds, as an archer corrects the aim by the last miss. Where proposals turn out worse, the
    midpoint is validated next. With `GaussNewton` as the optimizer a round is a step by the truer residual and the
    model's Jacobian, and one candidate is enough (model management: N. Alexandrov and R. Lewis, "An Overview of
    First-Order Model Management for Engineering Optimization", 2001).
    """

    terminal: ClassVar[bool] = True

    dynamics: Dynamics
    optimizer: Optimizer
    rounds: int = 3
    """Rounds of validation, at most; one only ranks the candidates."""
    candidates: int = 8
    """Validated in each round, none twice; in the first the warm start too, so that none replaces a better one."""
    tolerance: Tolerance = ()
    """Ends the rounds, by the residuals in the truer dynamics."""

    def __post_init__(self) -> None:
        for name, least in {"rounds": 1, "candidates": 1}.items():
            if getattr(self, name) < least:
                raise InputError(f"{name}: got {getattr(self, name)}, needs at least {least}")
        require_tolerance(self.tolerance)

    @property
    def differentiates(self) -> bool:
        """Return whether its optimizer needs gradients."""
        return self.optimizer.differentiates

    @property
    def elites(self) -> int:
        """Return how many of the best candidates it needs."""
        return max(self.candidates, self.optimizer.elites)

    def improve(self, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """Return the search after all rounds, or once the cheapest validation is within `tolerance`.

        The elites are ranked by the truer dynamics.
        """
        validations: list[Validation] = []
        proposals = np.concatenate([search.elites[:1], problem.warm_start[None], search.elites[1:]])
        for index in range(self.rounds):
            knots = not_validated(proposals, validations)[: self.candidates if validations else max(2, self.candidates)]
            if not len(knots):
                break
            results = problem.validate(self.dynamics, knots)
            for row, candidate in enumerate(knots):
                validations.append(Validation(candidate, float(results.costs[row]), results.row(row).residuals))
            best = min(validations, key=lambda validation: validation.cost)
            if index == self.rounds - 1 or converged(self.tolerance, best.cost, best.residuals):
                break
            if index and not any(best is other for other in validations[-len(knots) :]) and np.isfinite(best.cost):
                proposals = 0.5 * (best.knots + knots)
                continue
            inner = self.corrected(best, problem)
            elites = np.concatenate([best.knots[None], search.elites[:-1]])
            search = search._replace(mean=best.knots, elites=elites, costs=np.full(len(elites), np.inf, np.float32))
            search = self.optimizer.improve(search, random, inner)
            proposals = search.elites[np.isfinite(search.costs)]
        # Costs in the planner's own dynamics no longer count; where no validation is finite, the warm start stays.
        elites = np.concatenate([problem.warm_start[None], search.elites[:-1]])
        search = search._replace(elites=elites, costs=np.full(len(elites), np.inf, np.float32))
        costs = np.array([validation.cost for validation in validations], np.float32)
        return merged(search, np.stack([validation.knots for validation in validations]), costs)

    @staticmethod
    def corrected(validation: Validation, problem: Problem) -> Problem:
        """Return the problem with its residuals corrected to those of a validated candidate.

        It is the same one where the candidate's cost is not finite in the planner's own dynamics, or in the truer ones.
        """
        if not np.isfinite(validation.cost):
            return problem
        model_results = problem.evaluate(validation.knots[None])
        if not np.isfinite(model_results.costs[0]):
            return problem
        return problem.corrected(
            {name: residual - model_results.residuals[name] for name, residual in validation.residuals.items()}
        )


def not_validated(knots: np.ndarray, validations: list[Validation]) -> np.ndarray:
    """Return the knots (N, K, J, 3) that were not validated yet, in their order, each once."""
    done = {validation.knots.tobytes() for validation in validations}
    return knots[[row for row in distinct(knots) if knots[row].tobytes() not in done]]
