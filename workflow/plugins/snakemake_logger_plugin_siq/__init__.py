"""What Snakemake does, one line of JSON for each event, which `siq run` reads: `snakemake --logger siq`.

Each line begins with a control character that no message of a job begins with, so that both may come on
one stream.
"""

import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from snakemake_interface_logger_plugins.base import LogHandlerBase

MARK = "\x1e"  # the record separator, as in JSON text sequences (RFC 7464)
FIELDS = ("stats", "jobid", "job_id", "jobs", "rule_name", "rule_msg", "log", "done", "total", "exception")


def swallowed_target(arguments: Sequence[str]) -> str | None:
    """What to write instead where ``--configfile`` takes the target for a further file; None elsewhere.

    Snakemake takes all that follows it up to the next option, and then reads the target as YAML.
    """
    for place, argument in enumerate(arguments):
        if argument in ("--configfile", "--configfiles"):
            behind = arguments[place + 1 :]
            count = next((k for k, one in enumerate(behind) if one.startswith("-")), len(behind))
            files, rest = list(behind[:count]), list(behind[count:])
            targets = [one for one in files[1:] if Path(one).suffix not in (".yaml", ".yml", ".json")]
            if targets:
                kept = [one for one in files if one not in targets]
                return " ".join(["snakemake", *targets, *arguments[:place], *rest, argument, *kept])
    return None


class LogHandler(LogHandlerBase):
    """Events as lines of JSON on standard error."""

    writes_to_stream = True  # in the place of Snakemake's own lines, which stay in .snakemake/log
    writes_to_file = False
    has_filter = True
    has_formatter = True
    needs_rulegraph = False

    def emit(self, record: logging.LogRecord) -> None:
        """Write one event, or a message that belongs to none."""
        said = {name: getattr(record, name) for name in FIELDS if hasattr(record, name)}
        said |= {"event": str(getattr(record, "event", "")), "level": record.levelname}
        if not said["event"] or "exception" in said:
            said["text"] = record.getMessage()
        sys.stderr.write(f"\n{MARK}{json.dumps(said, default=str)}\n")
        sys.stderr.flush()


# Snakemake imports its plugins before it reads its arguments, and would end in a traceback. Other workflows
# are no concern of ours.
if Path("workflow", "plugins", __name__).is_dir() and (better := swallowed_target(sys.argv[1:])):
    sys.exit(f"--configfile takes the target for a second file; write the target first: {better}")
