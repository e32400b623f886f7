"""Parts of a solve that Python has, by their names."""

from __future__ import annotations

from unifg.problem.compiled_problem import CompiledProblem


def numbers_only(program: CompiledProblem) -> bool:
    """Test whether instances with other data differ in numbers that compiled loops read, and Python has no part."""
    return not (python_parts(program) or program.branches)


def python_parts(program: CompiledProblem) -> list[str]:
    """Parts of a solve that are Python's, besides the verification of answers, with their names."""
    found = {
        "terms that are not traced, but evaluated or differenced": [
            *program.left_to_python, *(term.name for term in program.terms if term.differenced),
        ],
        "terms whose functions assert something": [known.term.name for known in program.demanding],
        "data from which limits, weights or flags are made": [
            handle.name for handle, reader in program.readers.items() if reader.bound
        ],
        "soft constraints": list(program.soft),
        "constraints of fixed variables alone": [program.row_name(row)[0] for row in program.fixed_rows().tolist()],
        "families whose manifold has conditions of its own": [f.name for f, *_ in program.reader.particular],
    }  # fmt: skip
    parts = [f"{what}: {', '.join(dict.fromkeys(names))}" for what, names in found.items() if names]
    if not parts and (program.differenced or not program.fully_compiled):
        parts.append("a loss, a retraction or a derivative that is not compiled")
    return parts
