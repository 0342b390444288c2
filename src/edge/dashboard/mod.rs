//! Dashboards: pictures of what is on the bus, and nothing that is not on it.

pub mod terminal;
