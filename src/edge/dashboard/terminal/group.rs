//! Which quantities are drawn as waveforms.

use std::ops::Range;

use super::super::bed::quantity_infos;
use crate::model::cvsim6::Pressures;

/// Quantities that are drawn together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Group {
    /// The six pressures.
    Pressures,
    /// The six flows.
    Flows,
    /// The six volumes.
    Volumes,
}

impl Group {
    pub(super) const ALL: [Self; 3] = [Self::Pressures, Self::Flows, Self::Volumes];

    /// Positions of its quantities.
    pub(super) fn quantities(self) -> Range<usize> {
        let first = self as usize * Pressures::LEN;
        first..first + Pressures::LEN
    }

    pub(super) fn of(quantity: usize) -> Self {
        Self::ALL.into_iter().find(|g| g.quantities().contains(&quantity)).unwrap_or(Self::Pressures)
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Pressures => "pressures",
            Self::Flows => "flows",
            Self::Volumes => "volumes",
        }
    }

    pub(super) fn unit(self) -> &'static str {
        quantity_infos().nth(self.quantities().start).map_or("", |q| q.unit)
    }

    /// Shortest vertical axis: less than this is no movement worth filling the height with.
    pub(super) fn least_range(self) -> f64 {
        match self {
            Self::Pressures => 2.0,
            Self::Flows => 20.0,
            Self::Volumes => 8.0,
        }
    }

    pub(super) fn next(self) -> Self {
        match self {
            Self::Pressures => Self::Flows,
            Self::Flows => Self::Volumes,
            Self::Volumes => Self::Pressures,
        }
    }
}
