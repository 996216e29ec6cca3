"""The truth of intent: jobs, shards, videos, leases and their history, in SQLite or PostgreSQL."""
