"""A controller holds a steel ball in the air, with a Hall sensor and the voltage of a coil.

The sensor below the coil reads the field of the coil and that of the ball, which the coil magnetizes. The controller
subtracts the coil's part by the measured current. The rest over the current is a measure of the gap. The current
follows the voltage with the delay of the coil.

Runs: ``python -m warpmag.examples levitation``
"""

import math

import newton
import numpy as np
import warp as wp

import warpmag
import warpmag.examples

RADIUS, DENSITY = 0.006, 7870.0  # m and kg/m³, of the ball
COIL = {"shape": "solenoid", "radius": 0.012, "length": 0.03}
COIL_HEIGHT = 0.05  # m, of the coil's center
TURNS, RESISTANCE, SUPPLY = 1200, 4.0, 24.0  # Ω, V
SENSOR = COIL_HEIGHT - 0.5 * COIL["length"] - 0.001  # m, height of the Hall sensor
TARGET = 0.023  # m, height of the ball's center
STEP = 1e-3  # s, of simulation and control
GAIN, DAMPING, FILTER = 1.2, 0.018, 0.5  # change of the current over that of the signal; s; share of a new slope


def axial_field(distance):
    """Return the field on the axis of the coil per ampere [1/m], ``distance`` [m] from its center."""
    ends = distance + np.array([0.5, -0.5]) * COIL["length"]
    return TURNS / (2.0 * COIL["length"]) * float(np.diff((ends / np.hypot(ends, COIL["radius"]))[::-1])[0])


def holding_current(height: float) -> float:
    """Return the current [A] that holds the ball, from the pull 4π μ0 R³ H dH/dz on a ball of high permeability."""
    distance, step = COIL_HEIGHT - height, 1e-6
    slope = (axial_field(distance - step) - axial_field(distance + step)) / (2.0 * step)
    weight = DENSITY * 4.0 / 3.0 * math.pi * RADIUS**3 * 9.81
    return math.sqrt(weight / (4.0 * math.pi * 4e-7 * math.pi * RADIUS**3 * axial_field(distance) * slope))


class Example:
    """A ball on a stand below a coil."""

    def __init__(self, viewer, args):
        """Build the scene; at the target the ball's signal is that of a dipole of moment 4π R³ H."""
        builder = newton.ModelBuilder()
        warpmag.register_custom_attributes(builder)
        stand = TARGET - RADIUS - args.drop
        builder.add_shape_cylinder(
            -1, xform=wp.transform((0.0, 0.0, 0.5 * stand), wp.quat_identity()), radius=RADIUS, half_height=0.5 * stand
        )
        ball = builder.add_body(xform=wp.transform((0.0, 0.0, stand + RADIUS), wp.quat_identity()))
        builder.add_shape_sphere(ball, radius=RADIUS, cfg=newton.ModelBuilder.ShapeConfig(density=DENSITY))
        warpmag.add_inducible(builder, body=ball, material="1010-steel")
        above = wp.transform((0.0, 0.0, COIL_HEIGHT), wp.quat_identity())
        warpmag.add_coil(builder, **COIL, turns=TURNS, resistance=RESISTANCE, xform=above, label="coil")
        builder.add_site(-1, xform=wp.transform((0.0, 0.0, SENSOR), wp.quat_identity()), label="hall")

        self.simulation = warpmag.Simulation(builder, dt=STEP)
        model, magnetics = self.simulation.model, self.simulation.magnetics
        self.hall = warpmag.SensorMagnetometer(model, magnetics, "hall", noise=args.noise)
        self.own_signal = 4e-7 * math.pi * axial_field(COIL_HEIGHT - SENSOR)  # T/A, of the coil
        self.target_signal = 8e-7 * math.pi * RADIUS**3 * axial_field(COIL_HEIGHT - TARGET) / (SENSOR - TARGET) ** 3
        self.current, self.error, self.slope = holding_current(TARGET), 0.0, 0.0
        self.sim_time = 0.0
        self.display, self.viewer = warpmag.Display(viewer, model, magnetics), viewer

    @staticmethod
    def create_parser():
        """Return the parser of the example's options."""
        parser = warpmag.examples.create_parser(frames=60)
        parser.add_argument("--drop", type=float, default=0.001, help="Depth of the stand below the target [m].")
        parser.add_argument("--noise", type=float, default=2e-6, help="Noise of the Hall sensor [T].")
        return parser

    def voltage(self) -> float:
        """Return the voltage of the next step [V], from the measured current and the Hall sensor."""
        magnetics = self.simulation.magnetics
        current = float(magnetics.coils.currents.numpy()[0])
        self.hall.update(self.simulation.state)
        wanted = self.current
        if current > 0.1 * self.current:
            signal = float(self.hall.flux_density.numpy()[0, 2]) / current - self.own_signal
            error = signal / self.target_signal - 1.0
            self.slope += FILTER * ((error - self.error) / STEP - self.slope)
            self.error = error
            wanted *= 1.0 - GAIN * error - DAMPING * self.slope
        faster = 2.0 * (wanted - current)  # the current follows in a third of L/R
        return float(np.clip(RESISTANCE * (wanted + faster), -SUPPLY, SUPPLY))

    def step(self):
        """Advance by a frame of 10 ms."""
        for _ in range(10):
            self.simulation.magnetics.set_voltage("coil", self.voltage())
            self.simulation.step()
        self.sim_time = self.simulation.time

    def render(self):
        """Show the ball."""
        self.display.show(self.sim_time, self.simulation.state)

    def height(self) -> float:
        """Return the height of the ball's center [m]."""
        return float(self.simulation.state.body_q.numpy()[0, 2])

    def test_final(self):
        """Check that the ball floats at the target, at the current that carries its weight."""
        current = float(self.simulation.magnetics.coils.currents.numpy()[0])
        assert abs(self.height() - TARGET) < 2e-4, self.height()
        np.testing.assert_allclose(current, holding_current(self.height()), rtol=0.05)  # the controller's noise

    def summary(self) -> str:
        """Return the result in one line."""
        current = float(self.simulation.magnetics.coils.currents.numpy()[0])
        return f"the ball floats {1e3 * (self.height() - TARGET):+.3f} mm from its target, at {current:.3f} A"


if __name__ == "__main__":
    viewer, args = warpmag.examples.init(Example.create_parser())
    warpmag.examples.run(Example(viewer, args), args)
