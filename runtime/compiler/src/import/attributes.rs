//! Attributes of a node. Each attribute must be read: [`Attributes::all_read`] refuses the node
//! otherwise.

use std::cell::RefCell;
use std::collections::HashMap;
use std::sync::Arc;

use crate::onnx::AttributeProto;
use crate::tensor::Tensor;

/// Attribute types, as `AttributeProto.AttributeType` numbers them.
const FLOAT: i32 = 1;
const INT: i32 = 2;
const STRING: i32 = 3;
const TENSOR: i32 = 4;
const FLOATS: i32 = 6;
const INTS: i32 = 7;
const STRINGS: i32 = 8;

/// Attributes of a node that have not been read yet.
pub(super) struct Attributes<'n>(RefCell<HashMap<&'n str, &'n AttributeProto>>);

impl<'n> Attributes<'n> {
    pub fn new(attributes: &'n [AttributeProto]) -> Result<Self, String> {
        let mut by_name = HashMap::new();
        for attribute in attributes {
            if by_name.insert(attribute.name.as_str(), attribute).is_some() {
                return Err(format!("has attribute {} twice", attribute.name));
            }
        }
        Ok(Self(RefCell::new(by_name)))
    }

    fn take(&self, name: &str, kind: i32) -> Result<Option<&'n AttributeProto>, String> {
        match self.0.borrow_mut().remove(name) {
            Some(attribute) if attribute.kind != kind || !attribute.ref_attr_name.is_empty() => {
                Err(format!("has attribute {name} of a wrong type"))
            }
            found => Ok(found),
        }
    }

    pub fn int(&self, name: &str, default: i64) -> Result<i64, String> {
        Ok(self
            .take(name, INT)?
            .map_or(default, |attribute| attribute.i))
    }

    pub fn flag(&self, name: &str, default: bool) -> Result<bool, String> {
        Ok(self.int(name, i64::from(default))? != 0)
    }

    pub fn ints(&self, name: &str) -> Result<Option<&'n [i64]>, String> {
        Ok(self.take(name, INTS)?.map(|attribute| &attribute.ints[..]))
    }

    pub fn float(&self, name: &str, default: f32) -> Result<f32, String> {
        Ok(self
            .take(name, FLOAT)?
            .map_or(default, |attribute| attribute.f))
    }

    pub fn floats(&self, name: &str) -> Result<Option<&'n [f32]>, String> {
        Ok(self
            .take(name, FLOATS)?
            .map(|attribute| &attribute.floats[..]))
    }

    pub fn text(&self, name: &str) -> Result<Option<String>, String> {
        Ok(self
            .take(name, STRING)?
            .map(|attribute| String::from_utf8_lossy(&attribute.s).into_owned()))
    }

    pub fn texts(&self, name: &str) -> Result<Option<Vec<String>>, String> {
        let text = |attribute: &AttributeProto| {
            attribute
                .strings
                .iter()
                .map(|s| String::from_utf8_lossy(s).into_owned())
                .collect()
        };
        Ok(self.take(name, STRINGS)?.map(text))
    }

    pub fn tensor(&self, name: &str) -> Result<Option<Arc<Tensor>>, String> {
        match self.take(name, TENSOR)? {
            None => Ok(None),
            Some(AttributeProto { t: Some(proto), .. }) => Tensor::from_proto(proto).map(Some),
            Some(_) => Err(format!("has attribute {name} without a tensor")),
        }
    }

    /// Refuses a value other than the one that is supported.
    pub fn only(&self, name: &str, supported: i64) -> Result<(), String> {
        match self.int(name, supported)? {
            found if found == supported => Ok(()),
            found => Err(format!(
                "does not support {name} = {found}, only {supported}"
            )),
        }
    }

    /// Refuses the node if an attribute was not read.
    pub fn all_read(&self) -> Result<(), String> {
        match self.0.borrow().keys().min() {
            Some(name) => Err(format!("does not support attribute {name}")),
            None => Ok(()),
        }
    }
}
