"""What Snakemake does, one line of JSON for each event, which `siq run` reads: `snakemake --logger siq`.

Each line begins with a control character that no message of a job begins with, so that both may come on
one stream.
"""

import json
import logging
import sys

from snakemake_interface_logger_plugins.base import LogHandlerBase

MARK = "\x1e"  # the record separator, as in JSON text sequences (RFC 7464)
FIELDS = ("stats", "jobid", "job_id", "jobs", "rule_name", "rule_msg", "log", "done", "total", "exception")


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
