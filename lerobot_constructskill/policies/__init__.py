"""Policy types of our own. They run without a simulator."""
