"""The engine process: JSON-RPC over stdio, jobs with their state on disk."""
