"""Other people's local planners and their localiser, written anew, to compare with."""
