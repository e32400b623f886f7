"""The quadrotor: where it is, how it flies, as two graphs or one."""
