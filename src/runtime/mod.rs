//! The runtime: the clock, the worker pool, and the event loop that keeps many beds going.
//!
//! Invariants: one event loop over one closed enum ([`service::Event`]); solves run on a fixed pool; a bed is with
//! the loop or with one worker, never both, so its inputs are handled in order. Every queue has a limit, a policy
//! when it is full, and a counter. The bed whose samples have waited longest goes first. When the machine cannot keep up,
//! all beds go on with fewer members ([`governor`]): an event says so, and every estimate tells how many made it.
//! Deliberately absent: topics, bytes, files. What comes in is typed, what goes out goes to a [`service::Sink`].

pub mod bed;
pub mod clock;
pub mod governor;
pub mod offline;
pub mod service;
pub mod workers;
