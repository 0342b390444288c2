//! What a page orders: a note, or that an alarm was seen. An order takes as long as the daemon takes to answer; the page
//! gets its frames meanwhile, and is told how it ended.

use std::sync::Arc;

use serde_json::json;
use tokio::sync::mpsc::{Receiver, Sender, channel};

use super::super::errand::{Errand, Outcome};
use super::hub::Hub;

/// Orders of one page under way; a further one is refused.
const MAX_UNDER_WAY: usize = 4;

/// An errand of a page, by whom, and the word by which the page knows it.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Order {
    pub(super) word: &'static str,
    pub(super) errand: Errand,
    pub(super) author: String,
}

/// The orders of one page.
pub(super) struct Orders {
    answers: Sender<String>,
    ended: Receiver<String>,
}

impl Orders {
    pub(super) fn new() -> Self {
        let (answers, ended) = channel(MAX_UNDER_WAY);
        Self { answers, ended }
    }

    /// The answer to the next order that has ended; waits for one.
    pub(super) async fn next(&mut self) -> Option<String> {
        self.ended.recv().await
    }

    /// Starts an order. The answer if it cannot be started.
    pub(super) fn start(&self, order: Order, hub: &Arc<Hub>) -> Result<(), String> {
        let bed = order.errand.bed().to_owned();
        let refused = |text: &str| {
            let outcome = Outcome { text: text.to_owned(), is_failure: true };
            answer(order.word, &bed, &outcome)
        };
        let Some(bus) = hub.bus().cloned() else { return Err(refused("failed: the daemon is not reached")) };
        // Room for its answer is what lets an order in.
        let Ok(room) = self.answers.clone().try_reserve_owned() else {
            return Err(refused("failed: other orders of this page are still under way"));
        };
        let prefix = hub.with_ward(|ward| ward.prefix().to_owned());
        tokio::task::spawn_blocking(move || {
            let outcome = order.errand.run(bus.as_ref(), &prefix, &order.author);
            room.send(answer(order.word, &bed, &outcome));
        });
        Ok(())
    }
}

/// What the page is told; see the protocol.
fn answer(word: &str, bed: &str, outcome: &Outcome) -> String {
    if outcome.is_failure {
        tracing::warn!(bed, "{word} of a page: {}", outcome.text);
    }
    json!({ "kind": "answer", "order": word, "bed": bed, "ok": !outcome.is_failure, "text": outcome.text }).to_string()
}
