//! In which line of a TOML file a key stands.

use std::collections::BTreeMap;
use std::fmt;

use serde::Deserialize;
use serde::de::{Deserializer, Error, MapAccess, SeqAccess, Visitor};
use toml::Spanned;

use super::keys::KeyPath;

/// Lines, counted from 1, by key.
#[derive(Debug, Default)]
pub(super) struct Lines(BTreeMap<KeyPath, usize>);

impl Lines {
    /// Empty where the text has no spans to offer; an error without a line is better than none.
    pub(super) fn of(text: &str) -> Self {
        let mut lines = Self::default();
        if let Ok(root) = toml::from_str::<Node>(text) {
            lines.collect(text, &KeyPath::default(), &root);
        }
        lines
    }

    /// The line of a key, or of the innermost table or list around it.
    pub(super) fn get(&self, key: &KeyPath) -> Option<usize> {
        let mut path = key.clone();
        loop {
            if let Some(line) = self.0.get(&path) {
                return Some(*line);
            }
            path.0.pop()?;
        }
    }

    /// Makes the lines of one key, and of all below it, those of another.
    pub(super) fn alias(&mut self, from: &[&str], to: &[&str]) {
        let aliased = |(key, &line): (&KeyPath, &usize)| {
            let below = key.0.iter().skip(from.len()).cloned();
            (KeyPath(to.iter().map(|&segment| segment.to_owned()).chain(below).collect()), line)
        };
        let aliases: Vec<_> = self.0.iter().filter(|(key, _)| key.starts_with(from)).map(aliased).collect();
        self.0.extend(aliases);
    }

    fn collect(&mut self, text: &str, path: &KeyPath, node: &Node) {
        match node {
            Node::Leaf => {}
            Node::Table(entries) => {
                for (name, value) in entries {
                    self.enter(text, path.join(name.get_ref()), name.span().start, value);
                }
            }
            Node::List(entries) => {
                for (position, value) in entries.iter().enumerate() {
                    self.enter(text, path.join(position.to_string()), value.span().start, value.get_ref());
                }
            }
        }
    }

    fn enter(&mut self, text: &str, path: KeyPath, offset: usize, node: &Node) {
        self.collect(text, &path, node);
        self.0.insert(path, position(text, offset).0);
    }
}

/// Line and column, both from 1, of a byte offset.
pub(super) fn position(text: &str, offset: usize) -> (usize, usize) {
    let before = &text[..text.floor_char_boundary(offset)];
    let line = before.matches('\n').count() + 1;
    let column = before.chars().rev().take_while(|&c| c != '\n').count() + 1;
    (line, column)
}

/// A TOML value of which only the places matter.
enum Node {
    Leaf,
    Table(Vec<(Spanned<String>, Node)>),
    List(Vec<Spanned<Node>>),
}

impl<'de> Deserialize<'de> for Node {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(NodeVisitor)
    }
}

struct NodeVisitor;

impl<'de> Visitor<'de> for NodeVisitor {
    type Value = Node;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a TOML value")
    }

    fn visit_bool<E: Error>(self, _: bool) -> Result<Node, E> {
        Ok(Node::Leaf)
    }

    fn visit_i64<E: Error>(self, _: i64) -> Result<Node, E> {
        Ok(Node::Leaf)
    }

    fn visit_f64<E: Error>(self, _: f64) -> Result<Node, E> {
        Ok(Node::Leaf)
    }

    fn visit_str<E: Error>(self, _: &str) -> Result<Node, E> {
        Ok(Node::Leaf)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Node, A::Error> {
        let mut entries = Vec::new();
        while let Some(entry) = map.next_entry()? {
            entries.push(entry);
        }
        Ok(Node::Table(entries))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Node, A::Error> {
        let mut entries = Vec::new();
        while let Some(entry) = list.next_element()? {
            entries.push(entry);
        }
        Ok(Node::List(entries))
    }
}
