"""What LeRobot sees: the environment configuration and the Gymnasium environments."""
