//! hemostream
pub mod edge;
pub mod model;
