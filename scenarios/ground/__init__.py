"""The unicycle: where it is, where it drives, as two graphs or one."""
