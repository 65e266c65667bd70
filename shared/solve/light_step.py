"""One Gauss-Newton step of the log light with the albedo eliminated, and the loop around it.

The step solves (J^T W J + priors) d = -gradient by conjugate gradients. J is never formed: its product with a change
of light renders that change for all points and frames and removes what a change of albedo would absorb. J W-projects
orthogonally, so its transpose needs no second projection.

References: Golub and Pereyra, The differentiation of pseudo-inverses and nonlinear least squares problems whose
variables separate, 1973; Kaufman, A variable projection method for solving separable nonlinear least squares
problems, 1975.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from shared.solve.appearance import ROUGHNESS_RANGE, AppearanceSolver, State
from shared.solve.light import resample_light
from shared.solve.scale import scale_prior

_LARGEST_STEP = 1.5


def conjugate_gradients(product: Callable, right: np.ndarray, diagonal: np.ndarray, count: int, tolerance: float = 0.02):
    """Approximate solution of product(x) = right, preconditioned by a diagonal; at most count products."""
    x = np.zeros_like(right)
    residual = right.copy()
    z = residual / diagonal
    direction, power = z.copy(), float((residual * z).sum())
    first = power
    for _ in range(count):
        image = product(direction)
        curvature = float((direction * image).sum())
        if curvature <= 0.0:
            break
        length = power / curvature
        x += length * direction
        residual -= length * image
        z = residual / diagonal
        power, last = float((residual * z).sum()), power
        if power <= tolerance**2 * first:
            break
        direction = z + (power / last) * direction
    return x


class LightStep:
    """The linearised problem at the solver's present state."""

    def __init__(self, solver: AppearanceSolver):
        self.solver, state = solver, solver.state
        self.light = state.light
        self.irradiance, self.reflection = solver.forward(self.light)
        albedo = _channel_column(state.albedo)
        self.weight = solver.weights(albedo * self.irradiance + state.specular * self.reflection) * solver.fitted
        self.evidence = solver.evidence(self.weight)
        self.refresh()

    def refresh(self) -> None:
        """Albedo and specular intensity for the present light under fixed weights."""
        solver = self.solver
        if solver.settings.specular:
            args = (self.irradiance, self.reflection, self.weight)
            solver.state.specular = solver.fit_specular(*args, self.evidence)
        self.albedo = solver.eliminate(self.irradiance, self.reflection, self.weight)
        solver.state.albedo = self.albedo[..., 0].T.double().numpy()
        self.norm = (self.weight * self.irradiance.square()).sum(2, keepdim=True) + 1e-3

    def cost(self, log_light: np.ndarray) -> float:
        """Data and priors with albedo eliminated, weights and specular intensity held."""
        solver = self.solver
        irradiance, reflection = solver.forward(np.exp(log_light))
        albedo = solver.eliminate(irradiance, reflection, self.weight)
        model = albedo * irradiance + solver.state.specular * reflection
        data = 0.5 * self.evidence * float((self.weight * (model - solver.colours).square()).sum())
        prior = solver.frame_light.prior(log_light, solver.settings.priors)[0]
        log_albedo, log_irradiance, _ = solver.mean_on_skin(albedo, irradiance)
        matrix, right = scale_prior(log_albedo + log_irradiance, solver.settings.white_sigma)
        return data + prior + 0.5 * float(((matrix @ log_irradiance - right) ** 2).sum())

    def _render(self, change: np.ndarray) -> torch.Tensor:
        """Change of the model [3, P, F] for a change of log light [K, 3], off the albedo's reach."""
        solver = self.solver
        along = torch.from_numpy(solver.frame_light.along(self.light * change))
        result = self.albedo * torch.bmm(solver.baked, along.permute(2, 0, 1).contiguous())
        if solver.settings.specular:
            result += solver.state.specular * solver.reflect(along)
        part = (self.weight * self.irradiance * result).sum(2, keepdim=True) / self.norm
        return result - self.irradiance * part

    def _adjoint(self, values: torch.Tensor) -> np.ndarray:
        """Transpose of the unprojected rendering: [3, P, F] -> [K, 3]."""
        solver = self.solver
        along = torch.bmm(solver.baked.transpose(1, 2), self.albedo * values).permute(1, 2, 0)
        if solver.settings.specular:
            along = along + solver.state.specular * solver.reflect_adjoint(values)
        return self.light * solver.frame_light.adjoint(along.contiguous().numpy())

    def gradient(self) -> np.ndarray:
        """[K, 3] derivative of cost by the log light."""
        solver, state = self.solver, self.solver.state
        error = self.albedo * self.irradiance + state.specular * self.reflection - solver.colours
        data = self.evidence * self._adjoint(self.weight * error)
        log_albedo, log_irradiance, gauge = solver.mean_on_skin(self.albedo, self.irradiance)
        self.gauge = self.light * gauge
        self.scale_matrix, right = scale_prior(log_albedo + log_irradiance, solver.settings.white_sigma)
        scale = self.gauge * (self.scale_matrix.T @ (self.scale_matrix @ log_irradiance - right))
        _, prior, self.prior_product = solver.frame_light.prior(state.log_light, solver.settings.priors)
        return data + prior + scale

    def product(self, change: np.ndarray) -> np.ndarray:
        """Gauss-Newton Hessian times a change [K, 3]."""
        data = self.evidence * self._adjoint(self.weight * self._render(change))
        shift = (self.gauge * change).sum(0)
        return data + self.prior_product(change) + self.gauge * (self.scale_matrix.T @ (self.scale_matrix @ shift))

    def take(self, products: int = 15) -> None:
        """Moves the solver's log light: a damped step, halved until the cost falls."""
        state = self.solver.state
        gradient = self.gradient()
        diagonal = np.full_like(gradient, self.solver.settings.priors.smooth * 4.0 + 1e-3)
        diagonal += np.abs(self.gauge) * self.evidence
        step = conjugate_gradients(self.product, -gradient, diagonal, products)
        step *= min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), 1e-9))
        before = self.cost(state.log_light)
        for _ in range(6):
            if self.cost(state.log_light + step) < before:
                break
            step *= 0.5
        else:
            step *= 0.0
        state.log_light = state.log_light + step


def _channel_column(albedo: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(albedo.T, np.float32))[..., None]
