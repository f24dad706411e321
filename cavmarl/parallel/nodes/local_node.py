"""The program of a node that its caller has started on the same machine.

python -m cavmarl.parallel.nodes.local_node HOST PORT NUMBER    # the secret on standard input
"""

from __future__ import annotations

import sys

from cavmarl.parallel.nodes.node_process import run_node

if __name__ == "__main__":
    host, port, number = sys.argv[1:]
    try:
        run_node((host, int(port)), bytes.fromhex(sys.stdin.readline().strip()), int(number))
    except (EOFError, OSError):  # the caller has ended
        sys.exit(1)
