"""What tissue around a robot is like: how stiff, and how large a force it bears."""

AIRWAY_WALL_STIFFNESS_N_PER_MM2 = 0.032
"""N/mm for every mm of length, of an airway's wall under a long tube: pi/4 E / (1 - 0.5^2) (Popov, Contact
Mechanics and Friction, 2010: a cylinder's side) with E = 30.5 kPa (Eskandari, Arvayo, Levenston, Mechanical
properties of the airway tree, J. Appl. Physiol. 125, 2018: of pigs, along the airway, where it is stiffest)."""
MIN_WALL_STIFFNESS_N_PER_MM2, MAX_WALL_STIFFNESS_N_PER_MM2 = 1e-6, 1e3
"""Range of stiffnesses of a wall, N/mm^2, from gels to bone."""
CONTACT_FORCE_ALLOWED_N = 0.2
"""Default largest force at one place, 10 mm of the robot, N. Under a tube 2 mm thick it is a pressure of 10 kPa.
Mucosa of the trachea loses its blood flow under a pressure that lasts of 30 cm of water, 2.9 kPa (Seegobin and van
Hasselt, Endotracheal cuff pressure and tracheal mucosal blood flow, British Medical Journal 288, 1984): where a
robot rests, less must be asked for."""
MAX_CONTACT_FORCE_N = 10.0
"""Largest force at one place that may be allowed, N."""
