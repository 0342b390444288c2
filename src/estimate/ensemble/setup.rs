//! Settings against the model, and what is drawn before the first window.

use std::sync::OnceLock;

use rand_chacha::ChaCha8Rng;

use super::Parallel;
use crate::estimate::adapt::fit::ChannelFit;
use crate::estimate::settings::{ChannelSettings, EstimatorSettings, SettingsError};
use crate::model::{Cycle, Model};
use crate::xtfc::basis::Basis;
use crate::xtfc::features::{FeatureError, RandomFeatures};

/// Draws of a member's features before they are given up.
const MAX_REDRAWS: usize = 100;

pub(super) fn channel_fit(settings: &EstimatorSettings, channel: &ChannelSettings) -> ChannelFit {
    let stated = settings.drift.states[channel.state];
    let most = if stated > 0.0 { settings.adaptation.excess / stated } else { 1.0 };
    ChannelFit::new(settings.adaptation.noise, most)
}

pub(super) fn check<M: Model>(model: &M, settings: &EstimatorSettings) -> Result<(), SettingsError> {
    let length = |what, found, expected| {
        if found == expected { Ok(()) } else { Err(SettingsError::Length { what, found, expected }) }
    };
    let n = model.n_states();
    length("theta", settings.theta.len(), model.parameters().len())?;
    length("beliefs", settings.beliefs.len(), model.parameters().len())?;
    length("initial_state", settings.initial_state.len(), n)?;
    length("initial_state_sd", settings.initial_state_sd.len(), n)?;
    length("weights.physics", settings.weights.physics.len(), n)?;
    length("aleatoric_sd", settings.aleatoric_sd_mmhg.len(), n)?;
    length("drift.states", settings.drift.states.len(), n)?;
    if settings.members < 2 {
        return Err(SettingsError::Members(settings.members));
    }
    for (what, value) in [
        ("the window length", settings.window.length_ns),
        ("the publishing period", settings.publish_period_ns),
        ("the forecast limit", settings.window.forecast_limit_ns),
    ] {
        if value <= 0 {
            return Err(SettingsError::NotPositive(what));
        }
    }
    if !settings.channels.iter().all(|c| c.noise_sd_mmhg > 0.0) {
        return Err(SettingsError::NotPositive("the noise of every channel"));
    }
    if !settings.weights.physics.iter().all(|w| *w > 0.0) {
        return Err(SettingsError::NotPositive("the weight of every equation"));
    }
    let observable = |state: usize| state < n - model.n_discrepancies() && !model.is_free(state);
    if let Some(channel) = settings.channels.iter().find(|c| !observable(c.state)) {
        return Err(SettingsError::State(channel.state));
    }
    let estimable = |&p: &usize| model.parameters().get(p).is_some_and(|info| info.estimable);
    match settings.estimate.iter().find(|p| !estimable(p)) {
        Some(&p) => Err(SettingsError::Parameter(p)),
        None => Ok(()),
    }
}

/// What is estimated: a rate cannot be learnt without the clock it drives, so the beat phase comes along with the
/// heart rate.
pub fn with_companions<M: Model>(model: &M, estimate: &[usize]) -> Vec<usize> {
    let mut all = estimate.to_vec();
    if let Some(Cycle { rate, phase }) = model.cycle()
        && all.contains(&rate)
        && !all.contains(&phase)
    {
        all.push(phase);
    }
    all
}

/// Parameters that change: what is estimated, what makes the model periodic, and what its clocks move.
pub(super) fn varying<M: Model>(model: &M, estimated: &[usize], theta: &[f64]) -> Vec<usize> {
    let mut later = theta.to_vec();
    model.advance(1.0, &mut later);
    let clock = |p: usize| later[p].to_bits() != theta[p].to_bits();
    let cycle = |p: usize| model.cycle().is_some_and(|cycle| cycle.phase == p || cycle.rate == p);
    (0..theta.len()).filter(|&p| estimated.contains(&p) || cycle(p) || clock(p)).collect()
}

pub(super) fn draw_bases<M: Model>(
    model: &M,
    settings: &EstimatorSettings,
    rng: &mut ChaCha8Rng,
    parallel: &dyn Parallel,
) -> Result<Vec<Basis>, SettingsError> {
    if !settings.coupling.is_xtfc() {
        return Ok(Vec::new());
    }
    let length_s = settings.window.length_s();
    let free = (0..model.n_states()).any(|state| model.is_free(state));
    let draws = (0..settings.members).map(|_| RandomFeatures::draw(settings.features, rng));
    let features = draws.collect::<Result<Vec<_>, _>>()?;
    let basis = |features: &RandomFeatures| {
        let basis = Basis::new(features.clone(), length_s);
        if free { basis.and_then(Basis::with_free) } else { basis }
    };
    let slots: Vec<OnceLock<Basis>> = features.iter().map(|_| OnceLock::new()).collect();
    parallel.for_indices(features.len(), &|i| {
        if let Ok(basis) = basis(&features[i]) {
            // Every index comes once, so that the slot is empty.
            let _ = slots[i].set(basis);
        }
    });
    // Wide distributions now and then draw features that are all saturated: draw again, in the order of the members.
    let mut again = || {
        let mut draws = (0..MAX_REDRAWS).map(|_| basis(&RandomFeatures::draw(settings.features, rng)?));
        draws.find(Result::is_ok).unwrap_or(Err(FeatureError::Degenerate))
    };
    slots.into_iter().map(|slot| Ok(slot.into_inner().map_or_else(&mut again, Ok)?)).collect()
}
