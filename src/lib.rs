//! hemostream
pub mod edge;
pub mod estimate;
pub mod model;
pub mod runtime;
pub mod xtfc;
