//! Tests that what the documents tell people to type exists and does what they say: rules of the Makefile, commands, names of the C
//! interface, links, workflows.
//!
//! Blocks of commands are run as they are typed, see `commands`. A new block without a class, a rule that is gone, a name that was
//! changed: each is a failing test that says where.

mod commands;
mod interface;
mod links;
mod makefile;
mod workflows;
