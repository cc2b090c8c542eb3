"""Problems with known answers for solvers, and objectives that misbehave."""

import numpy as np

from orthocas import solvers

ALL = [
    solvers.GaussNewton(max_iterations=60, tolerance=1e-12),
    solvers.QuasiNewton(tolerance=1e-12),
    solvers.LBFGS(tolerance=1e-15),
    solvers.Ipopt(tolerance=1e-10),
    solvers.Adam(learning_rate=0.05),
    solvers.GradientFlow(tolerance=1e-9),
]
SHORT = [
    solvers.GaussNewton(max_iterations=3, tolerance=0.0),
    solvers.QuasiNewton(max_iterations=3, tolerance=0.0),
    solvers.LBFGS(max_iterations=3, tolerance=0.0),
    solvers.Ipopt(max_iterations=3),
    solvers.Adam(epochs=3, steps=10, learning_rate=0.05),
    solvers.GradientFlow(max_iterations=3, tolerance=0.0),
]
START = np.array([-1.2, 1.0])


class Valley:
    """Rosenbrock's function as least squares: minimum 0 at (1, 1)."""

    def residuals(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b = theta
        return np.array([1 - a, 10 * (b - a * a)]), np.array([[-1.0, 0.0], [-20 * a, 10.0]])

    def value(self, theta: np.ndarray) -> float:
        rho = self.residuals(theta)[0]
        return float(rho @ rho / 2)

    def value_and_gradient(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        rho, D = self.residuals(theta)
        return float(rho @ rho / 2), D.T @ rho

    def normal_equations(self, theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        rho, D = self.residuals(theta)
        return float(rho @ rho / 2), D.T @ rho, D.T @ D

    def curvature_estimate(self, theta: np.ndarray) -> list[np.ndarray]:
        D = self.residuals(theta)[1]
        return [D.T @ D]


class SmoothValley(Valley):
    """With its Hessian."""

    def hessian(self, theta: np.ndarray) -> np.ndarray:
        a, b = theta
        return np.array([[1 - 200 * (b - a * a) + 400 * a * a, -200 * a], [-200 * a, 100.0]])


class Interrupted(Valley):
    """Ctrl-C arrives after some evaluations."""

    def __init__(self, after: int) -> None:
        self.left = after

    def value(self, theta: np.ndarray) -> float:
        self.count()
        return super().value(theta)

    def value_and_gradient(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        self.count()
        return super().value_and_gradient(theta)

    def normal_equations(self, theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        self.count()
        return super().normal_equations(theta)

    def count(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt


class NotFinite(Valley):
    def residuals(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full(2, np.nan), np.full((2, 2), np.nan)


class Broken(Valley):
    """Fails with an error of its own."""

    def residuals(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        raise ZeroDivisionError("broken on purpose")


class Bowl:
    """min |theta|^2 / 2 with theta_1 + theta_2 <= bound and theta_1 - theta_2 = 1."""

    def __init__(self, bound: float, gap: float = 1.0) -> None:
        self.bounds = np.array([-np.inf, gap]), np.array([bound, 1.0])

    def value(self, theta: np.ndarray) -> float:
        return float(theta @ theta / 2)

    def value_and_gradient(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        return self.value(theta), theta

    def constraints(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        A = np.array([[1.0, 1.0], [1.0, -1.0]])
        return A @ theta, A

    def lagrangian_hessian(self, theta: np.ndarray, factor: float, multipliers: np.ndarray) -> np.ndarray:
        return factor * np.eye(2)


class TwoFaced(Bowl):
    """theta_1 + theta_2 <= -1 and >= 1 at once."""

    def __init__(self) -> None:
        self.bounds = np.array([-np.inf, 1.0]), np.array([-1.0, np.inf])

    def constraints(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        A = np.ones((2, 2))
        return A @ theta, A
