"""The way of a lambda into a front, counted as ``tools.walks`` counts; it may get shorter, and not longer."""

from tools.walks import Walk, front, guess

# Four look at a term, three at its units, sixteen at the guess; two count, three hold locks. The state of a solve has a
# file of its own, beside the frame around it, which costs five.
FILES, HAND_OVERS = 50, 180


def spelled(walk: Walk) -> str:
    """Message for the case that the numbers grow: calls by count, the most frequent first."""
    return "\n".join(f"{count} {' '.join(call)}" for call, count in walk.calls.most_common())


def test_a_lambda_reaches_a_front_in_few_hand_overs() -> None:
    walk = front()
    assert len(walk.files) <= FILES, sorted(walk.files)
    assert walk.hand_overs <= HAND_OVERS, spelled(walk)
    calls = set(walk.calls)
    assert ("unifg/modeling/model.py", "complete", "unifg/factors/residuals.py", "as_residual") in calls
    assert any(callee == "unifg/elimination/analysis.py" and what == "analyse" for _, _, callee, what in calls)


def test_counting_is_repeatable_and_sees_the_second_structure_of_nothing() -> None:
    assert front().calls == front().calls
    walk = guess()
    assert walk.calls == guess().calls
    # A prepared backend analyses nothing.
    assert not any(what == "analyse" for _, _, _, what in walk.calls)
