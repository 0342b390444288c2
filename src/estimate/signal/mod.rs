//! What can be read off a pressure waveform without a model of the circulation: where beats begin, and whether the
//! sensor can be trusted.

pub mod onset;
pub mod quality;
