"""Agents and what drives them: LeRobot policies, the references, simulators in lockstep."""
