//! hemostream
pub mod edge;
pub mod model;
pub mod xtfc;
