/*
 * lads: runs a compiled LADS policy in a controller. Made from runtime/ffi by cbindgen; do not edit.
 * Rules, examples: the crate's documentation and runtime/ffi/examples.
 */

#ifndef LADS_H
#define LADS_H

#include <stddef.h>
#include <stdint.h>
/**
 * Result of a call; 0 means success. The numbers are stable: no number ever changes its meaning.
 */
enum lads_status
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /**
     * Ok.
     */
    LADS_STATUS_OK = 0,
    /**
     * A pointer is null.
     */
    LADS_STATUS_NULL = 1,
    /**
     * A pointer does not have the alignment that its type or the documentation requires.
     */
    LADS_STATUS_MISALIGNED = 2,
    /**
     * A length exceeds the address space.
     */
    LADS_STATUS_TOO_LONG = 3,
    /**
     * Two of the memory areas overlap.
     */
    LADS_STATUS_OVERLAP = 5,
    /**
     * The policy was not opened or the controller was not set up, or it was moved or replaced since.
     */
    LADS_STATUS_NOT_SET_UP = 6,
    /**
     * A struct's struct_bytes is not set, or not a valid size.
     */
    LADS_STATUS_STRUCT_BYTES = 7,
    /**
     * Not a program image.
     */
    LADS_STATUS_NOT_AN_IMAGE = 10,
    /**
     * Program image of another version: compile the bundle again.
     */
    LADS_STATUS_IMAGE_VERSION = 11,
    /**
     * The program image is truncated.
     */
    LADS_STATUS_IMAGE_TRUNCATED = 12,
    /**
     * The program image is malformed.
     */
    LADS_STATUS_IMAGE_MALFORMED = 13,
    /**
     * This processor stores the most significant byte first; program images do not.
     */
    LADS_STATUS_BIG_ENDIAN = 14,
    /**
     * The program image has changed since it was compiled.
     */
    LADS_STATUS_IMAGE_CHECKSUM = 15,
    /**
     * A control step of the program image takes more work than is allowed.
     */
    LADS_STATUS_IMAGE_WORK = 16,
    /**
     * The program image needs an operation that this library was built without.
     */
    LADS_STATUS_IMAGE_OPERATION = 17,
    /**
     * The workspace is smaller than the policy needs.
     */
    LADS_STATUS_WORKSPACE_TOO_SMALL = 20,
    /**
     * The policy does not know this instruction.
     */
    LADS_STATUS_UNKNOWN_INSTRUCTION = 30,
    /**
     * There are no words, too many, or not a whole number of word embeddings.
     */
    LADS_STATUS_WORDS_LENGTH = 31,
    /**
     * A word element is not finite.
     */
    LADS_STATUS_WORDS_NOT_FINITE = 32,
    /**
     * The instruction could not be processed; no instruction is set now.
     */
    LADS_STATUS_INSTRUCT_FAILED = 33,
    /**
     * The channel has no element with this number.
     */
    LADS_STATUS_NO_ELEMENT = 34,
    /**
     * The policy has no channel with this number or name.
     */
    LADS_STATUS_NO_CHANNEL = 35,
    /**
     * The policy takes no instruction.
     */
    LADS_STATUS_NO_INSTRUCTION_TAKEN = 36,
    /**
     * No instruction has been set.
     */
    LADS_STATUS_NO_INSTRUCTION = 40,
    /**
     * A channel of the observation has another length than the contract's.
     */
    LADS_STATUS_OBSERVATION_LENGTH = 41,
    /**
     * The action has another length than the contract's.
     */
    LADS_STATUS_ACTION_LENGTH = 42,
    /**
     * An element that was given is not finite.
     */
    LADS_STATUS_NOT_FINITE = 43,
    /**
     * An element of the observation is outside the contract's limits.
     */
    LADS_STATUS_OUT_OF_LIMITS = 44,
    /**
     * The context is full: reset or set an instruction.
     */
    LADS_STATUS_CONTEXT_FULL = 45,
    /**
     * No step has been taken yet.
     */
    LADS_STATUS_NOTHING_EXECUTED = 46,
    /**
     * The policy computed a value that is not finite.
     */
    LADS_STATUS_RESULT_NOT_FINITE = 47,
    /**
     * A program of the step failed.
     */
    LADS_STATUS_STEP_FAILED = 48,
    /**
     * The policy holds no recorded episode to test itself with.
     */
    LADS_STATUS_NO_GOLDEN = 50,
    /**
     * The self-test's recorded instruction or one of its observations was refused.
     */
    LADS_STATUS_SELF_TEST_REFUSED = 51,
    /**
     * The self-test selected another index than recorded.
     */
    LADS_STATUS_SELF_TEST_SELECTED = 52,
    /**
     * The self-test computed another action than recorded.
     */
    LADS_STATUS_SELF_TEST_ACTION = 53,
    /**
     * Not armed: the self-test has not passed.
     */
    LADS_STATUS_NOT_ARMED = 60,
    /**
     * Stopped, until it is resumed.
     */
    LADS_STATUS_STOPPED = 61,
    /**
     * There is no observation in this period.
     */
    LADS_STATUS_NO_OBSERVATION = 62,
    /**
     * The observation is no later than the last one.
     */
    LADS_STATUS_STALE = 63,
    /**
     * More control periods were missed than tolerated.
     */
    LADS_STATUS_LATE = 64,
    /**
     * The timestamp is further ahead of the last one than max_jump allows.
     */
    LADS_STATUS_JUMP = 65,
    /**
     * A flag, a rule or a fallback is unknown to this library.
     */
    LADS_STATUS_UNKNOWN_OPTION = 70,
    /**
     * The limits of an action element do not overlap the contract's range.
     */
    LADS_STATUS_GUARD_LIMITS = 71,
    /**
     * A rate is not a finite number above zero.
     */
    LADS_STATUS_GUARD_RATE = 72,
    /**
     * The safe action is outside the limits.
     */
    LADS_STATUS_GUARD_SAFE_ACTION = 73,
    /**
     * The time constant of the decay is not a finite number above zero.
     */
    LADS_STATUS_GUARD_TIME_CONSTANT = 74,
    /**
     * A channel of the observation is missing, or the policy has more than one.
     */
    LADS_STATUS_CHANNEL_MISSING = 80,
    /**
     * A channel is given that is not an observation channel, or is given twice.
     */
    LADS_STATUS_CHANNEL_UNKNOWN = 81,
    /**
     * A channel is given with elements of another type.
     */
    LADS_STATUS_CHANNEL_TYPE = 82,
    /**
     * The rows of a channel are not contiguous.
     */
    LADS_STATUS_CHANNEL_ROWS = 83,
    /**
     * The other policy has another control period.
     */
    LADS_STATUS_SWAP_CONTROL_PERIOD = 90,
    /**
     * A channel of the other policy differs.
     */
    LADS_STATUS_SWAP_CHANNELS = 91,
    /**
     * The other policy has no instruction yet.
     */
    LADS_STATUS_SWAP_INSTRUCTION = 92,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum lads_status lads_status;
#else
typedef int32_t lads_status;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus


/**
 * Version of this interface; it grows when a program compiled for an older header would no longer work.
 */
#define LADS_ABI_VERSION 2

/**
 * Alignment of a workspace, in bytes: a cache line, which is also the widest vector.
 */
#define LADS_WORKSPACE_ALIGN 64

/**
 * Largest stack, in bytes, that a call of the library takes: measured on x86-64 with all functions
 * of the archive. Convolutions with integer weights take most; `lads inspect` tells a policy's own.
 */
#define LADS_STACK_BYTES 19456

/**
 * Number that stands for no channel, element or other index.
 */
#define LADS_NONE UINT32_MAX

/**
 * Number of 64-bit words of a `lads_policy`.
 */
#define LADS_POLICY_WORDS 96

/**
 * Behaviour at a full context: it restarts after the instruction, at timestep 0, and the policy
 * continues.
 */
#define LADS_BEYOND_RESTART 0

/**
 * Behaviour at a full context: the step is refused (`LADS_STATUS_CONTEXT_FULL`) until `lads_reset`
 * or an instruction.
 */
#define LADS_BEYOND_REFUSE 1

/**
 * Role of a channel that the caller gives in every control step.
 */
#define LADS_ROLE_OBSERVATION 0

/**
 * Role of a channel that every control step writes.
 */
#define LADS_ROLE_ACTION 1

/**
 * Role of a channel of word embeddings, `[words, elements]`.
 */
#define LADS_ROLE_INSTRUCTION 2

/**
 * Role of a channel of random numbers, drawn by the library unless `lads_step_channels` is given
 * them.
 */
#define LADS_ROLE_NOISE 3

/**
 * Role of a channel that holds a piece of a demonstration.
 */
#define LADS_ROLE_DEMONSTRATION 4

/**
 * Type of 32-bit floats.
 */
#define LADS_F32 0

/**
 * Type of bytes, such as the pixels of a camera.
 */
#define LADS_U8 1

/**
 * Type of signed 32-bit integers.
 */
#define LADS_I32 2

/**
 * Order of quaternions for a channel without any.
 */
#define LADS_QUATERNIONS_NONE 0

/**
 * Order of quaternions with the scalar first.
 */
#define LADS_QUATERNIONS_WXYZ 1

/**
 * Order of quaternions with the scalar last.
 */
#define LADS_QUATERNIONS_XYZW 2

/**
 * Largest number of axes of a channel.
 */
#define LADS_MAX_RANK 4

/**
 * Flag that arms the controller when it is set up, without a self-test. The caller who sets it
 * vouches for the policy on this machine.
 */
#define LADS_ARM_WITHOUT_SELF_TEST 1

/**
 * Flag that runs the same machine code on every processor of the target instead of the widest
 * instruction set of this one. The results have the same bits.
 */
#define LADS_PORTABLE_INSTRUCTIONS 2

/**
 * Fallback that moves to the safe action and stays there until `lads_resume`.
 */
#define LADS_FALLBACK_STOP 0

/**
 * Fallback that repeats the last action.
 */
#define LADS_FALLBACK_HOLD 1

/**
 * Fallback that moves towards the safe action with the time constant `decay_s`.
 */
#define LADS_FALLBACK_DECAY 2

/**
 * Noise of zeros, the mean of the standard normal distribution.
 */
#define LADS_NOISE_ZERO 0

/**
 * Noise of standard normal numbers; the same seed gives the same values on every target.
 */
#define LADS_NOISE_SEEDED 1

/**
 * A controller with its guard, at the start of its workspace; its content is private. Private.
 */
typedef struct lads_controller lads_controller;

/**
 * An open policy: a checked view on a program image, in memory of the caller. Its content is private; it may not be moved or
 * copied after it was opened, and the image has to stay where it is, unchanged, as long as the policy is used.
 */
typedef struct lads_policy {
    /**
     * Private content of the policy.
     */
    uint64_t private_words[LADS_POLICY_WORDS];
} lads_policy;

/**
 * Text in UTF-8, without a zero at the end: print it with "%.*s", (int)text.len, text.data.
 */
typedef struct lads_text {
    /**
     * Pointer to the first character; never null after a call wrote it.
     */
    const char *data;
    /**
     * Number of bytes.
     */
    size_t len;
} lads_text;

/**
 * Contract of a policy: its sizes, numbers of channels and texts.
 */
typedef struct lads_contract {
    /**
     * Size of the struct: set it to `sizeof(lads_contract)` before the call.
     */
    uint32_t struct_bytes;
    /**
     * Control period, the time from one control step to the next, in seconds.
     */
    float control_period_s;
    /**
     * Name of the family of policies, for example "lads"; informational, nothing depends on it.
     */
    struct lads_text family;
    /**
     * Name of the environment, for example "franka-kitchen".
     */
    struct lads_text environment;
    /**
     * Version of the environment.
     */
    struct lads_text environment_version;
    /**
     * SHA-256 of the bundle that the image was compiled from, hexadecimal.
     */
    struct lads_text bundle_sha256;
    /**
     * Language encoder that made the word embeddings; empty without instructions.
     */
    struct lads_text encoder;
    /**
     * SHA-256 of the language encoder's weights, hexadecimal.
     */
    struct lads_text encoder_sha256;
    /**
     * Number of channels, see `lads_channel`.
     */
    uint32_t channel_count;
    /**
     * Number of channels that are given in every control step; `lads_step` takes a single one,
     * `lads_step_channels` any number.
     */
    uint32_t observation_count;
    /**
     * Number of the first observation channel.
     */
    uint32_t observation;
    /**
     * Number of the action's channel.
     */
    uint32_t action;
    /**
     * Number of the channel of word embeddings; `LADS_NONE` for a policy that takes no instruction and needs none.
     */
    uint32_t instruction;
    /**
     * Number of instructions that the policy knows.
     */
    uint32_t instruction_count;
    /**
     * Number of elements of the first observation channel.
     */
    size_t observation_len;
    /**
     * Number of elements of an action.
     */
    size_t action_len;
    /**
     * Largest number of words of an instruction; 0 for a policy that takes none.
     */
    size_t words_len;
    /**
     * Number of elements of a word embedding.
     */
    size_t word_dim;
    /**
     * Smallest similarity to a known instruction at which another sentence may be followed, see
     * `lads_instruction_similarity`; above 1 if none may be.
     */
    float acceptance;
    /**
     * Number of control steps that a context holds; 0 if it is unbounded.
     */
    uint32_t context_steps;
    /**
     * Behaviour after that many control steps: `LADS_BEYOND_RESTART` or `LADS_BEYOND_REFUSE`.
     */
    uint32_t beyond;
    /**
     * Number of indices, such as those of latent plans, that the policy selects from; 0 for one
     * that selects nothing.
     */
    uint32_t index_count;
    /**
     * Divisor of the scores when an index is picked at random, unless `lads_set_decision` sets
     * another one; 0 for argmax.
     */
    float temperature;
    /**
     * Source of noise, `LADS_NOISE_ZERO` or `LADS_NOISE_SEEDED`, unless `lads_set_noise` sets
     * another one.
     */
    uint32_t noise;
    /**
     * Seed of the random picks.
     */
    uint64_t decision_seed;
    /**
     * Seed of the noise.
     */
    uint64_t noise_seed;
    /**
     * Largest number of values of noise that a control step takes; 0 for a policy without noise.
     */
    size_t noise_len;
    /**
     * Size of the image in bytes; bytes after it are not read.
     */
    size_t image_bytes;
    /**
     * Number of multiply-adds of the most expensive control step.
     */
    uint64_t worst_work;
} lads_contract;

/**
 * One channel: an input or output of the policy.
 */
typedef struct lads_channel_t {
    /**
     * Size of the struct: set it to `sizeof(lads_channel_t)` before the call.
     */
    uint32_t struct_bytes;
    /**
     * Role of the channel: `LADS_ROLE_OBSERVATION`, `_ACTION`, `_INSTRUCTION`, `_NOISE` or
     * `_DEMONSTRATION`.
     */
    uint32_t role;
    /**
     * Type of the channel's elements: `LADS_F32`, `LADS_U8` or `LADS_I32`.
     */
    uint32_t dtype;
    /**
     * Number of axes, 1 to 4.
     */
    uint32_t rank;
    /**
     * Lengths of the axes; 1 beyond the rank.
     */
    uint32_t dims[LADS_MAX_RANK];
    /**
     * Number of elements, which are in the order of the axes.
     */
    size_t len;
    /**
     * Name of the channel.
     */
    struct lads_text name;
    /**
     * Description of the reference that the values are relative to, such as "the observed joint
     * position"; empty where the bundle does not say.
     */
    struct lads_text reference;
    /**
     * Order of the components of the channel's quaternions: `LADS_QUATERNIONS_NONE`, `_WXYZ` or
     * `_XYZW`.
     */
    uint32_t quaternions;
    /**
     * 1 if the elements have names and units, 0 for images and the like, whose elements are alike.
     */
    uint32_t described;
} lads_channel_t;

/**
 * One element of a channel. Its physical value is reference + offset + scale * value, where the
 * reference is the channel's for this joint.
 */
typedef struct lads_element {
    /**
     * Size of the struct: set it to `sizeof(lads_element)` before the call.
     */
    uint32_t struct_bytes;
    /**
     * Smallest value, before scale and offset.
     */
    float min;
    /**
     * Largest value, before scale and offset.
     */
    float max;
    /**
     * Physical value of one unit of the element.
     */
    float scale;
    /**
     * Physical value for an element of zero, without the channel's reference.
     */
    float offset;
    /**
     * Name of the element; empty for an element of a channel without descriptions.
     */
    struct lads_text name;
    /**
     * Unit of the element; "1" for a dimensionless one.
     */
    struct lads_text unit;
    /**
     * Joint that the element belongs to; empty for none.
     */
    struct lads_text joint;
    /**
     * Quantity of the joint: "position", "velocity", "effort"; empty where the bundle does not
     * say.
     */
    struct lads_text interface;
    /**
     * Unit of the physical value; empty where the bundle does not say.
     */
    struct lads_text physical_unit;
} lads_element;

/**
 * One instruction that a policy knows.
 */
typedef struct lads_instruction {
    /**
     * Size of the struct: set it to `sizeof(lads_instruction)` before the call.
     */
    uint32_t struct_bytes;
    /**
     * Short name of the instruction.
     */
    struct lads_text id;
    /**
     * The instruction as a person says it.
     */
    struct lads_text text;
    /**
     * Number of words.
     */
    size_t words_len;
} lads_instruction;

/**
 * Options of a controller and its guard. All zero but the size
 * (`lads_options options = {sizeof options};`) means a guard with the contract's limits and no
 * rate limit that stops at the first fault. The lists have `action_len` elements and are copied;
 * null means the default.
 */
typedef struct lads_options {
    /**
     * Size of the struct: set it to `sizeof(lads_options)`.
     */
    uint32_t struct_bytes;
    /**
     * Flags: `LADS_ARM_WITHOUT_SELF_TEST`, `LADS_PORTABLE_INSTRUCTIONS`, or both.
     */
    uint32_t flags;
    /**
     * Action to write when the policy's action cannot be used: `LADS_FALLBACK_STOP`, `_HOLD` or
     * `_DECAY`.
     */
    uint32_t fallback;
    /**
     * Time constant of the decay, in seconds.
     */
    float decay_s;
    /**
     * Number of missed control periods between two steps that is still tolerated.
     */
    uint32_t late_after;
    /**
     * Number of periods in a row whose observation is missing, stale or refused, in which the last
     * action is repeated and the policy's state is kept before the fallback takes over.
     */
    uint32_t coast;
    /**
     * Number of interventions in a row after which the guard stops; 0 for never.
     */
    uint32_t stop_after;
    /**
     * Largest step from the last timestamp to the next, in its unit, such as ten control periods;
     * 0 for any, so that one corrupt timestamp makes all later ones stale until `lads_reset`. A
     * timestamp further ahead is considered corrupt: it is refused, and does not become the last
     * one, until the next one follows on it within the bound: then the time has really passed. Of
     * the first two of an episode either may be the corrupt one: the next timestamp is measured
     * from the second.
     */
    uint64_t max_jump;
    /**
     * Smallest actions; the contract's apply where they are narrower.
     */
    const float *min;
    /**
     * Largest actions; the contract's apply where they are narrower.
     */
    const float *max;
    /**
     * Largest change, in units of the action per second; unlimited if null.
     */
    const float *max_rate;
    /**
     * Action to which the stop and the decay lead, and from which the first action starts; if
     * null, zero or the limit nearest to it.
     */
    const float *safe_action;
} lads_options;

/**
 * Report of a call: the result of a control period, or the cause of a refusal.
 */
typedef struct lads_report {
    /**
     * Size of the struct: set it to `sizeof(lads_report)` before the call.
     */
    uint32_t struct_bytes;
    /**
     * Status that the call returned.
     */
    int32_t status;
    /**
     * 1 if the policy took a step; the next five fields are 0 otherwise.
     */
    uint32_t stepped;
    /**
     * Number of control steps since the context began.
     */
    uint32_t timestep;
    /**
     * 1 if an index is in force; the next three fields are 0 otherwise, as for a policy that
     * selects none.
     */
    uint32_t has_selected;
    /**
     * The index in force, such as that of a latent plan.
     */
    uint32_t selected;
    /**
     * The largest score of the last selection minus the second largest; infinite with a single one.
     */
    float margin;
    /**
     * 1 if this step selected the index, else 0.
     */
    uint32_t fresh;
    /**
     * 1 if the last action is repeated because the options tolerate this many missed observations.
     */
    uint32_t coasting;
    /**
     * 1 if an element of the action was at a limit or beyond and is now at the limit.
     */
    uint32_t saturated;
    /**
     * 1 if an element of the action moves as fast as it may, less far than it should.
     */
    uint32_t rate_limited;
    /**
     * Number of the channel that was refused; `LADS_NONE` if none was.
     */
    uint32_t channel;
    /**
     * Index of the first element of the channel that was refused, or of the word element;
     * `LADS_NONE` if none was.
     */
    uint32_t element;
    /**
     * Value of the refused element, for `LADS_STATUS_OUT_OF_LIMITS`; 0 otherwise.
     */
    float value;
    /**
     * Smallest value allowed, for `LADS_STATUS_OUT_OF_LIMITS`; 0 otherwise.
     */
    float min;
    /**
     * Largest value allowed, for `LADS_STATUS_OUT_OF_LIMITS`; 0 otherwise.
     */
    float max;
} lads_report;

/**
 * Measurements of a self-test, or the place of its failure.
 */
typedef struct lads_self_test_t {
    /**
     * Size of the struct: set it to `sizeof(lads_self_test_t)` before the call.
     */
    uint32_t struct_bytes;
    /**
     * Number of control steps replayed; this and the next two fields are 0 if the test failed.
     */
    uint32_t steps;
    /**
     * FNV-1a, of 32 bits, over the bits of all actions, as little-endian bytes: two targets with the same digest computed the same
     * bits.
     */
    uint32_t digest;
    /**
     * Largest absolute difference of an action element from the recorded one.
     */
    float largest_error;
    /**
     * Number of the first step that failed, counted from 0; `LADS_NONE` if none did.
     */
    uint32_t failed_step;
    /**
     * Index of the action's element that differed, for `LADS_STATUS_SELF_TEST_ACTION`; `LADS_NONE`
     * otherwise.
     */
    uint32_t element;
    /**
     * Recorded value at the failure: the element's value, or the index for
     * `LADS_STATUS_SELF_TEST_SELECTED`.
     */
    float expected;
    /**
     * Value that this target computed at the failure.
     */
    float got;
} lads_self_test_t;

/**
 * The clock of one control period.
 */
typedef struct lads_tick {
    /**
     * Size of the struct: set it to `sizeof(lads_tick)`.
     */
    uint32_t struct_bytes;
    /**
     * Number of control periods that have passed without a step since the last one.
     */
    uint32_t missed;
    /**
     * Time at which the observation was taken, in any unit. An observation that is not later than
     * the last one is stale.
     */
    uint64_t timestamp;
} lads_tick;

/**
 * The values of one channel. It has no `struct_bytes`, as it comes in lists; it will not grow.
 */
typedef struct lads_input {
    /**
     * Number of the channel.
     */
    uint32_t channel;
    /**
     * Type of the values, which is the channel's: `LADS_F32`, `LADS_U8` or `LADS_I32`.
     */
    uint32_t dtype;
    /**
     * Pointer to the values, contiguous and in the order of the channel's axes. Null means that
     * there is no observation.
     */
    const void *data;
    /**
     * Number of values.
     */
    size_t len;
    /**
     * Bytes from one row to the next, where the first axis counts rows, such as the lines of an
     * image. A line that is longer than its pixels is refused (`LADS_STATUS_CHANNEL_ROWS`), as the
     * library has no memory to pack lines into: copy them first. 0 means that there is no gap.
     */
    size_t row_bytes;
} lads_input;

/**
 * Counts of the guard since the controller was set up, in control periods. `policy` to `refused`
 * add up to `periods`.
 */
typedef struct lads_counters_t {
    /**
     * Size of the struct: set it to `sizeof(lads_counters_t)` before the call.
     */
    uint32_t struct_bytes;
    /**
     * Number of control periods.
     */
    uint64_t periods;
    /**
     * Number of periods with the policy's action.
     */
    uint64_t policy;
    /**
     * Number of periods before arming.
     */
    uint64_t not_armed;
    /**
     * Number of periods while stopped.
     */
    uint64_t stopped;
    /**
     * Number of periods without an observation.
     */
    uint64_t no_observation;
    /**
     * Number of periods with a stale observation, or one whose timestamp jumps.
     */
    uint64_t stale;
    /**
     * Number of periods in which too many periods had been missed.
     */
    uint64_t late;
    /**
     * Number of periods with an observation that was not finite.
     */
    uint64_t not_finite;
    /**
     * Number of periods with an observation outside the contract's limits.
     */
    uint64_t out_of_limits;
    /**
     * Number of periods in which the controller refused for another reason: no instruction, a full
     * context, a wrong length.
     */
    uint64_t refused;
    /**
     * Number of periods in which the last action was repeated; also counted above.
     */
    uint64_t coasted;
    /**
     * Number of missed periods.
     */
    uint64_t missed;
    /**
     * Number of periods with an action at a limit.
     */
    uint64_t saturated;
    /**
     * Number of periods with an action that the rate limit reduced.
     */
    uint64_t rate_limited;
} lads_counters_t;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * Returns the `LADS_ABI_VERSION` of the archive: compare it with the header's.
 */
uint32_t lads_abi_version(void);

/**
 * Returns one line in English for a status; never null. The text is static and ends with a zero.
 */
const char *lads_status_text(int32_t status);

/**
 * Opens a program image: checks all of it, its checksum included, and copies nothing. The image is
 * aligned to 4 bytes (64 is better); bytes after its own length are ignored. After a failure
 * `policy` holds no policy.
 *
 * # Safety
 * `image` points to `image_bytes` readable bytes that do not change as long as the policy or a controller of it is used;
 * `policy` may be written, and stays where it is.
 */
lads_status lads_policy_open(const uint8_t *image,
                             size_t image_bytes,
                             struct lads_policy *policy);

/**
 * Opens a program image, like `lads_policy_open`, but refuses one whose most expensive control
 * step takes more than `work_limit` multiply-adds; `lads_policy_open` refuses images that take
 * some seconds on a fast core.
 *
 * # Safety
 * The conditions of `lads_policy_open` hold.
 */
lads_status lads_policy_open_within(const uint8_t *image,
                                    size_t image_bytes,
                                    uint64_t work_limit,
                                    struct lads_policy *policy);

/**
 * Writes the contract of a policy: its sizes, numbers of channels and texts. The texts live as
 * long as the image.
 *
 * # Safety
 * `policy` is null or a `lads_policy`, zeroed or opened; `contract` may be read and written.
 */
lads_status lads_policy_contract(const struct lads_policy *policy, struct lads_contract *contract);

/**
 * Returns the number of channels of a policy; 0 if it was not opened.
 *
 * # Safety
 * `policy` is null or a `lads_policy`, zeroed or opened.
 */
uint32_t lads_channel_count(const struct lads_policy *policy);

/**
 * Writes the description of a channel, by its number from 0.
 *
 * # Safety
 * The conditions of `lads_policy_contract` hold.
 */
lads_status lads_channel(const struct lads_policy *policy, uint32_t number, struct lads_channel_t *channel);

/**
 * Finds the number of a channel by its name, byte for byte.
 *
 * # Safety
 * The conditions of `lads_policy_contract` hold; `name` points to `name_len` bytes, no zero needed; `number` may be written.
 */
lads_status lads_channel_find(const struct lads_policy *policy,
                              const char *name,
                              size_t name_len,
                              uint32_t *number);

/**
 * Writes the description of an element of a channel: name, unit, limits, joint, interface, and the
 * meaning of its values.
 *
 * # Safety
 * The conditions of `lads_policy_contract` hold.
 */
lads_status lads_channel_element(const struct lads_policy *policy,
                                 uint32_t channel,
                                 size_t index,
                                 struct lads_element *element);

/**
 * Writes an instruction that the policy knows, by its number.
 *
 * # Safety
 * The conditions of `lads_policy_contract` hold.
 */
lads_status lads_policy_instruction(const struct lads_policy *policy,
                                    uint32_t number,
                                    struct lads_instruction *instruction);

/**
 * Finds the number of the instruction with this id, or of the first with this text, up to the case of ASCII letters and white space.
 *
 * # Safety
 * The conditions of `lads_policy_contract` hold; `name` points to `name_len` bytes, no zero needed; `number` may be written.
 */
lads_status lads_policy_find_instruction(const struct lads_policy *policy,
                                         const char *name,
                                         size_t name_len,
                                         uint32_t *number);

/**
 * Returns the number of bytes of workspace for one controller of a policy; 0 if the policy was not
 * opened.
 *
 * # Safety
 * `policy` is null or a `lads_policy`, zeroed or opened.
 */
size_t lads_workspace_bytes(const struct lads_policy *policy);

/**
 * Sets up a controller with its guard in `workspace`, aligned to `LADS_WORKSPACE_ALIGN`, which
 * need not be initialised. `options` may be null; so may `controller`, the handle for the other
 * functions, which is the address of the workspace; so may `report`, which names the element of
 * the action whose limits, rate or safe action were refused. The controller is not armed unless
 * `LADS_ARM_WITHOUT_SELF_TEST` is set. A refusal leaves the workspace untouched: a controller that
 * runs there continues. To end a controller, stop using it: nothing has to be undone.
 *
 * # Safety
 * `policy` is null or a `lads_policy`, zeroed or opened; `workspace` points to `workspace_bytes` writable bytes that nobody
 * else uses or moves as long as the controller is used; lists in the options are as long as an action; `controller` is null or
 * may be written; `report` is null or may be read and written.
 */
lads_status lads_controller_init(const struct lads_policy *policy,
                                 void *workspace,
                                 size_t workspace_bytes,
                                 const struct lads_options *options,
                                 struct lads_controller **controller,
                                 struct lads_report *report);

/**
 * Replays the recorded episode, compares indices and actions, and arms the controller if it
 * passes, disarms it if not. Afterwards there is no instruction. `result`, which may be null, gets
 * the test's measurements, or the place of its failure.
 *
 * # Safety
 * `controller` is null or a workspace, zeroed or set up by `lads_controller_init`, and no other call uses it now;
 * `result` is null or may be read and written.
 */
lads_status lads_self_test(struct lads_controller *controller, struct lads_self_test_t *result);

/**
 * Replaces the running policy by another one, between two steps. `next` is a controller that was
 * set up in a workspace of its own, tested and given its instruction, which another thread may
 * have done while `controller` ran.
 *
 * Afterwards `next` is the one to step: it continues with the limits, rates, fallback, counters
 * and clock of `controller`, whose options stay in force, and its first action is no further from
 * the last executed one than the rate allows. It is armed if both were. `controller` is ended, and
 * its workspace is yours again, for the policy after that.
 *
 * If the swap is refused, neither controller changes. The reasons are another control period
 * (`LADS_STATUS_SWAP_CONTROL_PERIOD`), a channel that differs, which the report names
 * (`LADS_STATUS_SWAP_CHANNELS`), no instruction where `controller` has one
 * (`LADS_STATUS_SWAP_INSTRUCTION`). `report` may be null.
 *
 * # Safety
 * The conditions of `lads_self_test` hold for both controllers; `report` is null or may be read and written.
 */
lads_status lads_swap(struct lads_controller *controller, struct lads_controller *next, struct lads_report *report);

/**
 * Starts a new episode with the same instruction; timestamps may start anew. A stop stays a stop.
 *
 * # Safety
 * The conditions of `lads_self_test` hold.
 */
lads_status lads_reset(struct lads_controller *controller);

/**
 * Brings code, weights and KV caches into the processor's caches, so that the next step is as fast
 * as the ones after it; call it right before the first step, or after a pause. It costs two to
 * three control steps and changes nothing.
 *
 * # Safety
 * The conditions of `lads_self_test` hold.
 */
lads_status lads_warm(struct lads_controller *controller);

/**
 * Sets a known instruction, by its number, to follow from the next step on: a new episode.
 * `LADS_STATUS_INSTRUCT_FAILED`, which never occurs with a sound image, leaves the controller
 * without an instruction. A policy whose contract has no instruction channel needs none.
 *
 * # Safety
 * The conditions of `lads_self_test` hold.
 */
lads_status lads_set_instruction(struct lads_controller *controller, uint32_t number);

/**
 * Sets an instruction given as word embeddings, `len = n * word_dim` elements, like
 * `lads_set_instruction`. A policy follows any words, whatever they say: ask
 * `lads_instruction_similarity` first. `report`, which may be null, names the word element that
 * was refused.
 *
 * # Safety
 * The conditions of `lads_self_test` hold; `words` points to `len` readable elements; `report` is null or may be read and written.
 */
lads_status lads_set_words(struct lads_controller *controller,
                           const float *words,
                           size_t len,
                           struct lads_report *report);

/**
 * Finds the known instruction that a sentence, given as word embeddings, is most similar to, and
 * its similarity, from -1 to 1. A program that accepts free sentences compares the similarity with
 * the contract's `acceptance` and refuses sentences below: the policy follows any words. Words are
 * compared, not meanings. `number` may be null.
 *
 * # Safety
 * `policy` is null or a `lads_policy`, zeroed or opened; `words` points to `len` readable elements; `number` is null or may be
 * written, `similarity` may be written.
 */
lads_status lads_instruction_similarity(const struct lads_policy *policy,
                                        const float *words,
                                        size_t len,
                                        uint32_t *number,
                                        float *similarity);

/**
 * Sets how indices are picked: by argmax (`temperature` not above 0) or at random with the softmax
 * of the scores over the temperature.
 *
 * # Safety
 * The conditions of `lads_self_test` hold.
 */
lads_status lads_set_decision(struct lads_controller *controller, float temperature, uint64_t seed);

/**
 * Sets the source of a policy's noise: `LADS_NOISE_ZERO`, or `LADS_NOISE_SEEDED` with a seed,
 * whose generator starts again.
 *
 * # Safety
 * The conditions of `lads_self_test` hold.
 */
lads_status lads_set_noise(struct lads_controller *controller, uint32_t rule, uint64_t seed);

/**
 * Runs one control period of a policy with one observation channel of floats: writes an action
 * that is finite and inside limits and rates, whatever the observation is. `LADS_STATUS_OK` means
 * that it is the policy's action; any other status states why it is the fallback's. A null
 * `observation` means that there is none. `tick` may be null, then nothing is stale or late; so
 * may `report`, which names the channel and the element that was refused.
 *
 * Nothing is written, and no period is counted, only where there is no room for an action:
 * `controller` is null, misaligned or not set up; `action` is null, misaligned, of another length
 * than the contract's, or overlaps the workspace or the image. Any other fault of the call, such
 * as a `tick` or a `report` that is misaligned, has no size or overlaps, makes it a period without
 * an observation: the fallback's action is written, the status states the fault, and so does the
 * report unless it is at fault.
 *
 * # Safety
 * The conditions of `lads_self_test` hold; `observation` and `action` point to as many elements as they say; `tick` and `report` are null or may
 * be read, and the report written.
 */
lads_status lads_step(struct lads_controller *controller,
                      const float *observation,
                      size_t observation_len,
                      const struct lads_tick *tick,
                      float *action,
                      size_t action_len,
                      struct lads_report *report);

/**
 * Runs one control period of any policy, like `lads_step`: `inputs` are the values of all
 * observation channels, in any order; a null pointer means that there is no observation. Values
 * for a noise channel, as many as the contract's `noise_len` in the order in which they are used,
 * take the place of the library's.
 *
 * # Safety
 * The conditions of `lads_step` hold; `inputs` points to `count` inputs, whose data are as many values of their type as they say.
 */
lads_status lads_step_channels(struct lads_controller *controller,
                               const struct lads_input *inputs,
                               size_t count,
                               const struct lads_tick *tick,
                               float *action,
                               size_t action_len,
                               struct lads_report *report);

/**
 * Tells which action was executed since the last step, if it is not the one that `lads_step`
 * wrote; the next step continues from there. `report`, which may be null, names the element that
 * was refused.
 *
 * # Safety
 * The conditions of `lads_self_test` hold; `action` points to `action_len` readable elements; `report` is null or may be read and written.
 */
lads_status lads_executed(struct lads_controller *controller,
                          const float *action,
                          size_t action_len,
                          struct lads_report *report);

/**
 * Stops the controller as `LADS_FALLBACK_STOP` does, from the next step on.
 *
 * # Safety
 * The conditions of `lads_self_test` hold.
 */
lads_status lads_stop(struct lads_controller *controller);

/**
 * Ends a stop. The episode continues where it was; `lads_reset` starts a new one.
 *
 * # Safety
 * The conditions of `lads_self_test` hold.
 */
lads_status lads_resume(struct lads_controller *controller);

/**
 * Writes the counts of the guard's actions and interventions since the controller was set up.
 *
 * # Safety
 * The conditions of `lads_self_test` hold; `counters` may be read and written.
 */
lads_status lads_counters(struct lads_controller *controller, struct lads_counters_t *counters);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* LADS_H */
