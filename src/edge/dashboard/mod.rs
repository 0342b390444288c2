//! Dashboards: pictures of what is on the bus, and nothing that is not on it.
//!
//! [`terminal`] and [`web`] show the same `ward`, which takes in messages, knows no clock and no screen, and grows
//! without limit in nothing. `feed` brings the messages; an `errand` tells the daemon what an
//! operator says.

mod bed;
mod errand;
mod feed;
mod history;
mod past;
pub mod terminal;
mod ward;
pub mod web;
