"""The criterion of model selection on heads whose best model is known, since all is linear and Gaussian.

A grey head of a few points: the logarithm of what a frame shows of a point is its log albedo, drawn from the prior on
skin, a light of few harmonics along the point's normal, and noise. Simple and fuller models know harmonics to a lower
and to a higher order. Their marginal likelihood is known exactly, so that all that the criterion leaves out is, too.
"""

from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from toy_capture import swinging

from shared.appearance.fit import Phase, Solution, StepReport
from shared.appearance.light_models import real_harmonics
from shared.appearance.skin_prior import SkinPrior, SkinVariation
from shared.geometry.transforms import fibonacci_sphere, world_from_head
from shared.imaging.frame_index import hold_out
from shared.selection.candidates import WORTHWHILE, Decision, joint_errors, judge

NOISE, FRAMES, SEEDS, SIMPLE = 0.05, 150, 30, 1
NORMALS = fibonacci_sphere(100)
NORMALS = NORMALS[NORMALS[:, 2] > 0.4]
POINTS = len(NORMALS)
PULL = SkinPrior(80.0 * NORMALS, np.ones(POINTS, bool), SkinVariation()).at(np.zeros((3, POINTS)), np.ones(POINTS))
LEVEL = 1e-4 / POINTS
"""Of each entry of a precision: that of the albedo's mean, of which the prior says nothing."""
SKIN = PULL.average.T @ (PULL.average.T @ PULL.brightness).T + LEVEL
"""[P, P] precision of the log albedo."""
LIGHT = 1.0
"""Standard deviation of a harmonic under the light's own prior."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Harmonics up to an order without the constant, which is the albedo's, as frames show them: basis [P, F, K], of
    which some are held out, fitted [F] bool."""

    basis: np.ndarray
    fitted: np.ndarray

    def solve(self, samples, whole=False):
        """The most likely log albedo [P] and harmonics [K] of samples [P, F], and their errors."""
        design, precision = equations_of(self, whole)
        some = samples if whole else samples[:, self.fitted]
        found = np.linalg.solve(precision, design.T @ some.ravel() / NOISE)
        albedo, light = found[:POINTS], found[POINTS:]
        return albedo, light, samples - albedo[:, None] - self.basis @ light

    def report(self, samples):
        """What a step of the solve would say of samples [P, F]."""
        albedo, _, error = self.solve(samples)
        fitted, held_out = (float(np.sqrt(np.square(error[:, some]).mean())) for some in (self.fitted, ~self.fitted))
        return report_of(fitted, held_out, PULL.cost(np.tile(albedo, (3, 1))), np.abs(error).mean(0))

    def evidence(self, samples):
        """Log marginal likelihood of all samples [P, F] up to a constant of all models, and what of it the criterion
        leaves out: the light's own prior and the logarithm of the volumes."""
        albedo, light, error = self.solve(samples, whole=True)
        volume = 0.5 * np.linalg.slogdet(equations_of(self, True)[1])[1] + len(light) * np.log(LIGHT)
        left_out = 0.5 * np.square(light / LIGHT).sum() + volume
        return -0.5 * np.square(error / NOISE).sum() - 0.5 * albedo @ SKIN @ albedo - left_out, left_out


@cache
def equations_of(model, whole):
    """How samples of all frames or of the fitted ones, over the noise, follow from log albedo and harmonics [P + K] of
    a model, and the precision of these."""
    basis = model.basis if whole else model.basis[:, model.fitted]
    albedo = np.repeat(np.eye(POINTS)[:, None], basis.shape[1], axis=1)
    design = np.concatenate([albedo, basis], axis=2).reshape(-1, POINTS + basis.shape[2]) / NOISE
    precision = design.T @ design
    precision[:POINTS, :POINTS] += SKIN
    precision[POINTS:, POINTS:] += np.eye(basis.shape[2]) / LIGHT**2
    return design, precision


def report_of(fitted, held_out, skin_prior, frame_errors):
    return StepReport(
        fitted=fitted, held_out=held_out, cost=0.0, rescaled=0.0, skin_prior=skin_prior, specular_intensity=0.0,
        roughness=0.5, light_weights=(), rise=1.0, frame_errors=frame_errors, scale=None,
    )  # fmt: skip


@cache
def linear_model(order, moves, frames=FRAMES):
    turned = np.einsum("fij,pj->pfi", world_from_head(swinging(frames), moves), NORMALS)
    basis = real_harmonics(turned.reshape(-1, 3), order)[:, 1:]
    return LinearModel(basis.reshape(POINTS, frames, -1), hold_out(frames, 3))


def head(seed, order, moves, extra, frames=FRAMES):
    """Samples [P, F] of one head under harmonics up to an order: those of the simple model at a half, the rest at
    extra."""
    rng, basis = np.random.default_rng(seed), linear_model(order, moves, frames).basis
    albedo = np.linalg.solve(np.linalg.cholesky(SKIN + 1.0 / POINTS).T, rng.normal(size=POINTS))
    size = np.where(np.arange(basis.shape[2]) < (SIMPLE + 1) ** 2 - 1, 0.5, extra)
    light = basis @ (size * rng.normal(size=len(size)))
    return albedo[:, None] + light + NOISE * rng.normal(size=light.shape)


def joint_of(report, capture):
    """[H] errors of a model's held-out frames as model selection has them."""
    record = report.record("harmonics_2", 8, 0, Phase.SOLVING)
    solution = Solution(None, (record,), report.fitted, report.held_out, frame_errors=report.frame_errors)
    return joint_errors(capture, solution, POINTS * FRAMES)


@dataclass(frozen=True)
class Comparison:
    """A simple and a fuller model of one head: errors of the held-out frames [H] as model selection has them and
    without the prior, and by how much the fuller one's log marginal likelihood is more, and what is left out less."""

    joint: list[np.ndarray]
    alone: list[np.ndarray]
    evidence: float
    left_out: float

    def decision(self, errors):
        return judge(*errors, WORTHWHILE["light"])

    @property
    def accepted(self):
        return self.decision(self.joint).accepted


@cache
def compared(seed, order, moves, extra):
    samples = head(seed, order, moves, extra)
    models = [linear_model(some, moves) for some in (SIMPLE, order)]
    fitted, reports = models[0].fitted, [model.report(samples) for model in models]
    (simple, simple_left), (fuller, fuller_left) = (model.evidence(samples) for model in models)
    return Comparison(
        joint=[joint_of(report, SimpleNamespace(fitted=fitted)) for report in reports],
        alone=[report.frame_errors[~fitted] for report in reports],
        evidence=fuller - simple,
        left_out=fuller_left - simple_left,
    )


def heads(order, moves, extra):
    return [compared(seed, order, moves, extra) for seed in range(SEEDS)]


@pytest.mark.parametrize("moves", ["head", "camera"])
def test_the_marginal_likelihood_is_that_of_the_samples(moves):
    """By the samples' own covariance, of few frames."""
    frames = 6
    samples, found, direct = head(3, 2, moves, 0.3, frames), [], []
    for order in (SIMPLE, 2):
        model = linear_model(order, moves, frames)
        flat = model.basis.reshape(samples.size, -1)
        covariance = np.kron(np.linalg.inv(SKIN), np.ones((frames, frames))) + LIGHT**2 * flat @ flat.T
        covariance += NOISE**2 * np.eye(samples.size)
        direct.append(multivariate_normal.logpdf(samples.ravel(), cov=covariance))
        found.append(model.evidence(samples)[0])
    assert found[1] - found[0] == pytest.approx(direct[1] - direct[0], rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("held_out", [True, False])
def test_the_residual_to_judge_by_costs_what_residual_and_prior_cost(held_out):
    """Under a Gaussian of the residual's own variance: n / 2 by itself, and the prior's cost on top of that."""
    fitted, independent, cost = hold_out(12, 3) if held_out else np.ones(12, bool), 900.0, 40.0
    capture, report = SimpleNamespace(fitted=fitted), report_of(0.03, 0.05, cost, np.full(12, 0.04))
    count, residual = (300.0, report.held_out) if held_out else (900.0, report.fitted)
    judged = report.judged(capture, independent)
    assert count * judged**2 / (2.0 * residual**2) == pytest.approx(count / 2.0 + cost)
    assert replace(report, skin_prior=0.0).judged(capture, independent) == residual
    rise = replace(report, skin_prior=0.01).judged(capture, independent) / residual
    assert count * np.log(rise) == pytest.approx(0.01, rel=1e-3)  # as where the variance is free, to first order


def test_frames_are_raised_as_their_residual_is():
    """The candidates' errors and the steps' residual follow one rule."""
    report, fitted = linear_model(2, "camera").report(head(0, 2, "camera", 1.0)), hold_out(FRAMES, 3)
    capture = SimpleNamespace(fitted=fitted)
    raised = joint_of(report, capture) / report.frame_errors[~fitted]
    assert raised == pytest.approx(report.judged(capture, POINTS * FRAMES) / report.held_out) and raised[0] > 1.002


@pytest.mark.parametrize("order", [2, 4])
def test_unknowns_that_follow_noise_alone_are_not_worth_their_while(order):
    """Of thirty heads that turn at most two are given 5, or 21, harmonics that are not there. If any fall at all were
    enough, many decisions would stay open, and take them."""
    found = heads(order, "head", 0.0)
    assert sum(some.accepted for some in found) <= 2
    assert max(some.evidence for some in found) < -5.0
    if order == 2:
        assert sum(judge(*some.joint, 0.0).accepted for some in found) > SEEDS / 3


@pytest.mark.parametrize("order, extra", [(2, 0.2), (4, 0.05)])
def test_unknowns_that_frames_show_are_taken(order, extra):
    found = heads(order, "head", extra)
    assert [some.decision(some.joint) for some in found] == [Decision.SERVES] * SEEDS
    assert min(some.evidence for some in found) > 50.0


def test_where_no_frame_tells_light_from_albedo_the_likelier_albedo_wins():
    """A camera about a still head. Frames alone are indifferent, and would leave the light in the albedo."""
    found = heads(3, "camera", 1.0)
    for some in found:
        simple, fuller = (errors.mean() for errors in some.alone)
        assert abs(fuller / simple - 1.0) < 0.003
        assert some.decision(some.alone) is Decision.DOES_NOT and some.decision(some.joint) is Decision.SERVES
    assert np.median([some.evidence for some in found]) > 30.0


def test_a_likely_albedo_keeps_the_simple_model_where_no_frame_tells():
    found = heads(2, "camera", 0.0)
    assert sum(some.accepted for some in found) <= 1
    assert max(some.evidence for some in found) < 0.0


def test_weak_unknowns_that_are_there_are_taken_earlier_than_by_their_marginal_likelihood():
    """What their volumes would cost is no reason to leave them out."""
    found = [some for some in heads(4, "head", 0.01) if some.evidence < -5.0]
    assert len(found) > SEEDS / 2 and np.mean([some.accepted for some in found]) > 0.7


CASES = [
    (2, "head", 0.0), (4, "head", 0.0), (2, "head", 0.2), (4, "head", 0.05), (2, "camera", 1.0), (3, "camera", 1.0),
]  # fmt: skip
"""Order, what moves and size of the harmonics that only the fuller model knows."""


def test_models_rank_as_by_their_marginal_likelihood():
    """Where that is clear, a hundred to one and more."""
    found = [some for case in CASES for some in heads(*case) if abs(some.evidence) > np.log(100.0)]
    agree = [some.accepted == (some.evidence > 0.0) for some in found]
    assert len(found) > 5 * SEEDS and np.mean(agree) >= 0.97
    assert 0.2 < np.mean([some.evidence > 0.0 for some in found]) < 0.8


@pytest.mark.parametrize("order, extra", [(2, 0.5), (4, 0.0)])
def test_what_the_prior_says_counts_as_in_the_marginal_likelihood_but_for_the_volumes(order, extra):
    """Where frames cannot tell, the error falls, as a logarithm and over the held-out samples, by the log marginal
    likelihood and what is left out of it: the light's own prior, and the unknowns' volumes."""
    count = POINTS * (~linear_model(order, "camera").fitted).sum()
    for some in heads(order, "camera", extra):
        simple, fuller = (np.log(errors.mean()) for errors in some.joint)
        assert count * (simple - fuller) == pytest.approx(some.evidence + some.left_out, rel=0.07, abs=0.3)


def test_without_the_volumes_an_albedo_that_is_likelier_by_chance_can_win():
    """The known limit: 21 harmonics that are not there explain some of the albedo of a still head."""
    found = heads(4, "camera", 0.0)
    assert max(some.evidence for some in found) < -5.0
    assert 0.15 < np.mean([some.accepted for some in found]) < 0.6
