//! `/api/beds`: everything that is known of the present, in JSON, with the names of the JSON twins.

use std::time::Duration;

use serde_json::{Map, Value, json};

use super::super::bed::Bed;
use super::super::ward::Ward;
use super::describe;

/// All beds.
pub(super) fn beds(ward: &Ward, now: Duration) -> Value {
    let beds: Vec<Value> = ward.beds.iter().map(|(name, b)| Value::Object(bed(name, b, now))).collect();
    json!({
        "prefix": ward.prefix(),
        "messages": ward.messages, "unreadable": ward.unreadable, "refused": ward.refused,
        "beds": beds,
    })
}

fn bed(name: &str, bed: &Bed, now: Duration) -> Map<String, Value> {
    let mut fields = describe::condition(name, bed, now);
    fields.insert("time_ns".to_owned(), json!(bed.state.as_ref().map(|(t, _)| t)));
    fields.insert("since_data_s".to_owned(), json!(bed.state.as_ref().map(|(_, row)| row.since_data_s)));
    fields.insert("quantities".to_owned(), by_name(describe::quantities(bed)));
    fields.insert("parameters".to_owned(), by_name(describe::parameters(bed)));
    fields.insert("beat".to_owned(), describe::beat(bed.beat()));
    fields.insert("alarms".to_owned(), json!(describe::alarms(bed)));
    fields.insert("health".to_owned(), describe::status(bed));
    fields
}

/// Entries under their names.
fn by_name(entries: Vec<Value>) -> Value {
    let named = entries.into_iter().filter_map(|mut entry| {
        let name = entry.as_object_mut()?.remove("name")?;
        Some((name.as_str()?.to_owned(), entry))
    });
    Value::Object(named.collect())
}
