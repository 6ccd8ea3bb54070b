"""Report on a capture: facts and problems, as ``dyngs data inspect`` shows them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from dyngs.capture.first_points import checked_points
from dyngs.capture.inspection.facts import facts_of
from dyngs.capture.inspection.problems import problems_of, transforms_file_problems
from dyngs.capture.inspection.scene_problems import listed
from dyngs.config import DataConfig
from dyngs.data.capture import Capture
from dyngs.errors import DyngsError, printable, reading
from dyngs.files.containment import images_up_to, leaving_links


@dataclass(frozen=True)
class InspectReport:
    """Facts and problems of a capture.

    Attributes:
        root: the capture folder.
        capture: as it was read, None where that failed.
        facts: (name, value) pairs for people, in order.
        problems: everything suspicious, one line each; empty for a capture that looks right.
    """

    root: Path
    capture: Capture | None
    facts: tuple[tuple[str, str], ...]
    problems: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether there are no problems."""
        return not self.problems


def inspect_capture(source: Path | DataConfig, deep: bool = False) -> InspectReport:
    """Return a report on the capture at ``source``; what makes a capture unreadable is a problem in it, no error.

    Args:
        source: the folder, or the options by which it would be read.
        deep: decode every image in full and videos to files, which is slow and finds truncated files; otherwise
            only headers are read, and frames of videos only where they are decoded already.
    """
    from dyngs.data.read import read_capture

    options = source if isinstance(source, DataConfig) else DataConfig(root=source)
    links = [f"{path}: a link that leads out of the capture, to {place}" for path, place in leaving_links(options.root)]
    try:
        capture = read_capture(options, decode_videos=deep)
        with images_up_to(options.max_megapixels), reading(options.root, "`dyngs --debug` shows where"):
            report = report_on(capture, deep)
    except DyngsError as error:
        more = (*listed(links, str), *transforms_file_problems(options.root, str(error)))
        return InspectReport(options.root, None, (), (str(error), *more))
    return replace(report, problems=(*listed(links, str), *report.problems))


def report_on(capture: Capture, deep: bool = False) -> InspectReport:
    """Return the report on a capture that has been read; see ``inspect_capture``."""
    checked, line = capture, None
    with suppress(DyngsError):  # images that cannot be read, which is a problem of its own
        checked, line = checked_points(capture, DataConfig(root=capture.root))
    noise = [line] if line is not None and checked.points is None else []
    problems = dict.fromkeys([*capture.warnings, *noise, *problems_of(checked, deep)])
    return InspectReport(capture.root, capture, facts_of(capture), tuple(problems))


def format_report(report: InspectReport) -> str:
    """Return the report as plain text of several lines."""
    width = max((len(name) for name, _ in report.facts), default=0)
    lines = [f"capture {report.root}"]
    lines += [f"  {name:<{width}}  {value}" for name, value in report.facts]
    if report.ok:
        lines.append("nothing suspicious")
    else:
        lines.append(f"suspicious ({len(report.problems)}):")
        lines += [f"  - {printable(problem)}" for problem in report.problems]
    return "\n".join(lines)
