//! A frame as the page reads it: a head in JSON and numbers behind it; see the protocol.

use serde_json::{Value, json};

/// Numbers behind the head, and what they are.
#[derive(Default)]
pub(super) struct Parts {
    heads: Vec<Value>,
    numbers: Vec<f32>,
}

impl Parts {
    /// Adds a part; `head` says what it is.
    pub(super) fn add(&mut self, head: Value, numbers: impl IntoIterator<Item = f32>) {
        self.heads.push(head);
        self.numbers.extend(numbers);
    }

    /// Whether there is none.
    pub(super) fn is_empty(&self) -> bool {
        self.heads.is_empty()
    }

    /// The bytes of a frame; the parts go into the head.
    pub(super) fn into_frame(self, mut head: Value) -> Vec<u8> {
        if let Value::Object(fields) = &mut head {
            fields.insert("parts".to_owned(), Value::Array(self.heads));
        }
        frame(&head, &self.numbers)
    }
}

/// The bytes of a frame.
pub(super) fn frame(head: &Value, numbers: &[f32]) -> Vec<u8> {
    let head = head.to_string();
    let padding = head.len().next_multiple_of(4) - head.len();
    let mut bytes = Vec::with_capacity(4 + head.len() + padding + 4 * numbers.len());
    bytes.extend(u32::try_from(head.len()).unwrap_or(u32::MAX).to_le_bytes());
    bytes.extend(head.bytes());
    bytes.extend(std::iter::repeat_n(0, padding));
    bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
    bytes
}

/// An event time as the page takes it: it does not fit a JavaScript number.
pub(super) fn time(ns: i64) -> Value {
    json!(ns.to_string())
}

/// Times as seconds after the first.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation)]
pub(super) fn seconds_after(t0_ns: i64, times_ns: impl IntoIterator<Item = i64>) -> Vec<f32> {
    times_ns.into_iter().map(|t| (t.saturating_sub(t0_ns) as f64 * 1e-9) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_stand_on_a_multiple_of_four_behind_the_head() {
        for pad in 0..4 {
            let mut parts = Parts::default();
            parts.add(json!({"part": "x".repeat(pad)}), [1.5, f32::NAN]);
            let bytes = parts.into_frame(json!({"kind": "bed"}));
            let head_length = usize::try_from(u32::from_le_bytes(bytes[..4].try_into().unwrap())).unwrap();
            let head: Value = serde_json::from_slice(&bytes[4..4 + head_length]).unwrap();
            assert_eq!(head["parts"][0]["part"], "x".repeat(pad));
            let numbers = &bytes[(4 + head_length).next_multiple_of(4)..];
            assert_eq!(numbers.len(), 8);
            assert_eq!(numbers[..4], 1.5_f32.to_le_bytes());
            assert!(f32::from_le_bytes(numbers[4..].try_into().unwrap()).is_nan());
        }
    }
}
