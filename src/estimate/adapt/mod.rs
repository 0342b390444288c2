//! What the ensemble learns about its own assumptions: how fast parameters move, how noisy sensors are, whether the
//! model fits. None of it knows the model; all of it looks at innovations and at what updates did.

pub mod fit;
pub mod pace;
