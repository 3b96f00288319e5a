"""The simulated robot: scene, tasks, physics, oracle and renderer."""
