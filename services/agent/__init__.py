"""The agent: leases, supervised worker slots, commits. Runs inside `vipectl up` or alone beside a Ray cluster."""
