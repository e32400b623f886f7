"""Records of what is known of a map: residuals, bounds, clusters of loop closures, and the verdict made of them."""

from __future__ import annotations

from dataclasses import dataclass
from math import isinf
from typing import Literal, TypeAlias

from unifg.modeling.summary import counted
from unifg.solution.fit import FAR, is_far, ratio_sentence
from unifg.typing import Array, IntArray

__all__ = ["Certificate", "Cluster", "Effort", "Judgement", "Kind", "Verdict"]

Effort: TypeAlias = Literal["cheap", "full"]
Kind: TypeAlias = Literal["survey", "contradicted", "slipped", "unsupported"]
NAMED = 5  # clusters and edges


@dataclass(frozen=True, eq=False)
class Judgement:
    """Residuals of a pose graph at its poses, and its structure.

    Attributes:
        chi2: sum of r' Omega r.
        freedom: rows that carry information less unknowns; what chi2 is expected to be. Not positive where the
            measurements only just determine the poses, or do not.
        worst: up to five edges with the largest r' Omega r, as (k, 2) identifiers of their poses.
        worst_chi2: (k,) r' Omega r of those.
        parts: connected parts.
        anchors: identifiers of poses that are held where they are because nothing else holds their part.
        isolated: identifiers of poses without any measurement.
        blind: positions of edges whose information matrix is zero.
        indefinite: positions of edges whose information matrix has a negative eigenvalue.
        dim: degrees of freedom of a pose.
    """

    chi2: float
    freedom: int
    worst: IntArray
    worst_chi2: Array
    parts: int
    anchors: tuple[int, ...]
    isolated: tuple[int, ...]
    blind: IntArray
    indefinite: IntArray
    dim: int

    @property
    def far(self) -> bool:
        """True if residuals are far larger than stated."""
        return is_far(self.chi2, self.freedom)

    def sentences(self) -> list[str]:
        """Remarks on the solution; empty when there are none."""
        said = []
        if self.far:
            said.append(ratio_sentence(self.chi2, self.freedom))
        if self.freedom < 0:
            said.append(f"{-self.freedom} unknowns more than rows of measurements: some poses are not determined")
        if self.parts > 1:
            held = f"; held are the first poses, {_some(self.anchors)}" if self.anchors else ""
            said.append(f"{self.parts} parts that nothing connects{held}")
        if self.isolated:
            said.append(f"{counted(len(self.isolated), 'pose')} without any measurement: {_some(self.isolated)}")
        if len(self.blind):
            edges, first = counted(len(self.blind), "edge"), int(self.blind[0])
            said.append(f"{edges} without information, the first in place {first}")
        if len(self.indefinite):
            edges, first = counted(len(self.indefinite), "edge"), int(self.indefinite[0])
            said.append(f"{edges} with indefinite information, the first in place {first}")
        return said


@dataclass(frozen=True, eq=False)
class Certificate:
    """Bounds on the cost of the best map of a pose graph.

    Attributes:
        certified: the chordal cost of the given poses is at most `tolerance` above the least possible one.
        chi2: chordal cost of the given poses, with the weights of the graph.
        dual: chordal cost that no poses whatever fall below.
        gap: chi2 less dual; certified where it is at most `tolerance`.
        tolerance: absolute.
        least_eigenvalue: of the dual matrix on the frames; negative where the relaxation shows a way down.
        poses: (n, storage) stationary point of the chordal cost near the given poses, anchors where they were.
        moved: greatest distance [m] and turn [rad] from the given poses to those; no criterion.
        rank: dimension of the frames in which the staircase ended; that of the world where it was not climbed.
        caveats: sentences, what of the graph's weights the chordal cost does not hold.
        interval: bounds on the least sum of r' Omega r over all maps, r the logarithm: a lower bound, and its value at
            the given poses. None where there is none.
        no_interval: the reason for that; empty otherwise.
        better: (n, storage) solution, by the residual asked for, that a solve from `poses` ended at, where its chi2 is
            lower than that of the given poses by more than the relative tolerance; otherwise None.
        better_chi2: chi2 of the given poses by that residual and of `better`; None without it.
    """

    certified: bool
    chi2: float
    dual: float
    gap: float
    tolerance: float
    least_eigenvalue: float
    poses: Array
    moved: tuple[float, float]
    rank: int
    caveats: tuple[str, ...]
    interval: tuple[float, float] | None
    no_interval: str
    better: Array | None = None
    better_chi2: tuple[float, float] | None = None

    def sentence(self) -> str:
        """Claims that hold, and those that are not made."""
        if self.certified:
            text = f"no map has a lower chordal chi2 than {self.chi2:.6g}, that of this one (but for {self.gap:.1g})"
        else:
            text = (
                f"not certified: the chordal chi2 of this map is {self.chi2:.6g}, "
                f"and a map as low as {self.dual:.6g} is not excluded"
            )
        said = [text, f"a stationary point of that cost lies {self.moved[0]:.2g} m and {self.moved[1]:.2g} rad away"]
        if self.better_chi2 is not None:
            said.append(
                f"a better map was found: chi2 {self.better_chi2[1]:.6g}, of this one {self.better_chi2[0]:.6g}"
            )
        if self.interval is None:
            said.append(f"no interval is claimed for chi2: {self.no_interval}")
        else:
            least, here = self.interval
            wide = f", {here / least:.3g} times as much" if least > 0.0 else ""
            said.append(f"chi2 of the best map lies between {least:.6g} and {here:.6g}{wide}, that of this one")
        return "; ".join([*said, *self.caveats, "nothing is claimed of robust losses"])


@dataclass(frozen=True, eq=False)
class Cluster:
    """Loop closures between the same two stretches, steps of odometry, or sightings, with an error in common.

    Attributes:
        kind: "contradicted" by the rest; "unsupported", where nothing but themselves speaks for them; "slipped" for
            steps of odometry of which one is contradicted; "survey" for sightings of several landmarks from one
            stretch, which the rest contradicts.
        edges: (k,) positions in the graph; of a survey, there are none.
        stretches: (2, 2) identifiers of the first and last pose of both stretches; of a survey, those of the first and
            last pose and of the landmarks with the lowest and highest number.
        squared: fall of chi2 where their error is free, of contradicted ones their squared innovation.
        leverage: share of what the map knows of how the stretches lie that comes from them, 0 to 1.
        deviations: standard deviations by which the map moves where their error is free, in its own measure; infinite
            where it falls apart. Steps of odometry have none.
        moved: greatest distance [m] and turn [rad] by which poses move in the map that was solved again without them,
            and without what is contradicted more than they are; None where that was not done, or nothing is left.
        chi2: of the others, with them and without; None likewise.
        sightings: of a survey, their kind and (k,) positions; else None.
    """

    kind: Kind
    edges: IntArray
    stretches: IntArray
    squared: float
    leverage: float
    deviations: float
    moved: tuple[float, float] | None = None
    chi2: tuple[float, float] | None = None
    sightings: tuple[str, IntArray] | None = None

    def sentence(self) -> str:
        """The cluster, and what depends on it."""
        (a, b), (c, d) = self.stretches.tolist()
        one, other = (f"{low} to {high}" if low != high else f"{low}" for low, high in ((a, b), (c, d)))
        if self.kind == "slipped":
            text = f"a step of odometry between {a} and {d}"
        elif self.sightings is not None:
            text = f"the survey of landmarks {other} from {one} ({counted(len(self.sightings[1]), 'sighting')})"
        else:
            text = f"{counted(len(self.edges), 'closure')} of {one} with {other}"
        if self.moved is None or self.chi2 is None:
            return text
        moved = f"moves by {self.moved[0]:.2g} m and {self.moved[1]:.2g} rad"
        return (
            f"{text} (without, the map {'falls apart' if isinf(self.deviations) else moved}, "
            f"and chi2 of the others falls from {self.chi2[0]:.6g} to {self.chi2[1]:.6g})"
        )


@dataclass(frozen=True, eq=False)
class Verdict:
    """Confidence in the map of a pose graph.

    Attributes:
        effort: that was spent.
        judgement: residuals against what was stated, and what nothing connects or measures.
        certificate: bounds on what another map could gain; None where there are none.
        uncertified: the reason for that; empty otherwise.
        starts: first guesses from which the graph was solved besides; none with little effort.
        basins: different minima that these and the given map are.
        better: (n, storage) poses of a map with a lower chi2 that was found, otherwise None.
        better_chi2: chi2 of the given map and of that one; None without it.
        clusters: surveys, contradicted ones, slipped steps, then unsupported ones. Surveys and the first five of the
            others were solved again without.
        leverage: (m,) of the cluster of each closure; zero for odometry and edges that do not count.
        weak: names of unknowns of which less than five digits are known.
        ended: False where more may be contradicted than is listed, or an unknown is not determined: then none is.
        seconds: wall-clock time by part.
        left_out: number of edges that do not count, such as those that a robust loss has rejected.
        closures: number of loop closures that count, and a bound on the number of which every two are consistent with
            each other and with odometry, see :func:`unifg.pose_graphs.consistency.most_consistent`. None where every
            edge counts, with little effort, and where there is no bound.
        better_landmarks: (k, p) landmarks of the map `better`; None without it.
    """

    effort: Effort
    judgement: Judgement
    certificate: Certificate | None
    uncertified: str
    starts: int
    basins: int
    better: Array | None
    better_chi2: tuple[float, float] | None
    clusters: tuple[Cluster, ...]
    leverage: Array
    weak: tuple[str, ...]
    ended: bool
    seconds: dict[str, float]
    left_out: int = 0
    closures: tuple[int, int] | None = None
    better_landmarks: Array | None = None

    @property
    def claim(self) -> str:
        """Rank of the map among others: "proven", "better one known", "best of k basins" or "not compared"."""
        if self.better is not None:
            return "better one known"
        if self.certificate is not None and self.certificate.certified:
            return "proven"
        return f"best of {counted(self.basins, 'basin')}" if self.starts else "not compared with others"

    @property
    def interval(self) -> tuple[float, float] | None:
        """Bounds on chi2 of the best map, from the certificate; None where it has none."""
        return None if self.certificate is None else self.certificate.interval

    def of(self, kind: Kind) -> tuple[Cluster, ...]:
        """Clusters of a kind."""
        return tuple(cluster for cluster in self.clusters if cluster.kind == kind)

    def sentence(self) -> str:
        """The verdict in one sentence."""
        judged = self.judgement
        bounds = "" if self.interval is None else " in [{:.6g}, {:.6g}]".format(*self.interval)
        without = f" without the {counted(self.left_out, 'edge')} left out" if self.left_out else ""
        said = [f"{self.claim}{without}: chi2 {judged.chi2:.6g}{bounds} with {judged.freedom} degrees of freedom"]
        if self.better_chi2 is not None:
            said.append(f"a map of chi2 {self.better_chi2[1]:.6g} was found")
        if self.closures is not None:
            kept, most = self.closures
            bound = f"at most {most} closures are" if most > kept else "no larger set of closures is"
            said.append(f"{bound} consistent pair by pair; {kept} are kept")
        words: dict[Kind, str] = {
            "survey": "all others contradict {}",
            "contradicted": "the rest contradicts {}",
            "slipped": "loops contradict {}",
            "unsupported": "nothing else supports {}",
        }
        left = NAMED
        for kind, text in words.items():
            found = self.of(kind)
            named, left = found[:left], left - len(found[:left])
            more = f"{len(found) - len(named)} more" if len(found) > len(named) else ""
            if found:
                listed = ", ".join([*(one.sentence() for one in named), *([more] if more else [])])
                said.append(text.format(listed))
        if not self.clusters and self.ended:
            said.append("no cluster of closures is contradicted or without support")
        if not self.ended:
            said.append("more may be contradicted: solve with a robust loss")
        pairs = zip(judged.worst.tolist(), judged.worst_chi2.tolist(), strict=True)
        if worst := [f"{a} - {b} ({squared:.3g})" for (a, b), squared in pairs if squared > FAR * judged.dim]:
            said.append(f"worst edges {', '.join(worst)}")
        if self.weak:
            said.append(f"hardly determined: {', '.join(self.weak[:NAMED])}{', ...' if len(self.weak) > NAMED else ''}")
        return "; ".join([*said, *judged.sentences()])


def _some(identifiers: tuple[int, ...]) -> str:
    """The first of them, and how many there are more."""
    first = ", ".join(map(str, identifiers[:3]))
    return first if len(identifiers) <= 3 else f"{first} and {len(identifiers) - 3} more"
