//! Tests of the crates together; see `tests/`.
