"""`python -m siq`: the command, where its program is not on the path."""

import sys

from siq.workflow.command import main

sys.exit(main())
