/*
 * lads: runs a compiled LADS policy in a controller. Made from runtime/ffi by cbindgen; do not edit.
 * Rules, examples: the crate's documentation and runtime/ffi/examples.
 */

#ifndef LADS_H
#define LADS_H

#include <stddef.h>
#include <stdint.h>

/**
 * Version of this interface; it grows when a program compiled for an older header would no longer work.
 */
#define LADS_ABI_VERSION 1

/**
 * Alignment of a workspace, in bytes: a cache line, which is also the widest vector.
 */
#define LADS_WORKSPACE_ALIGN 64

/**
 * Stack that a call of the library takes at most, in bytes: measured on x86-64 with all functions of the archive.
 */
#define LADS_STACK_BYTES 6224

/**
 * Words of a `lads_policy`.
 */
#define LADS_POLICY_WORDS 96

/**
 * Flag: arm when the controller is set up, without a self-test. Whoever sets it vouches for the policy on this machine.
 */
#define LADS_ARM_WITHOUT_SELF_TEST 1

/**
 * Flag: run the same machine code on every processor of the target instead of the widest instructions that this one has.
 * The results have the same bits.
 */
#define LADS_PORTABLE_INSTRUCTIONS 2

/**
 * Fallback: to the safe action, and stay there until `lads_resume`.
 */
#define LADS_FALLBACK_STOP 0

/**
 * Fallback: the last action again.
 */
#define LADS_FALLBACK_HOLD 1

/**
 * Fallback: towards the safe action with the time constant `decay_s`.
 */
#define LADS_FALLBACK_DECAY 2

/**
 * What came of a call; 0 is good. The numbers are stable: none ever changes its meaning.
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
     * A pointer is not aligned as its type or the documentation asks.
     */
    LADS_STATUS_MISALIGNED = 2,
    /**
     * A length is larger than memory can be.
     */
    LADS_STATUS_TOO_LONG = 3,
    /**
     * Two of the memory areas overlap.
     */
    LADS_STATUS_OVERLAP = 5,
    /**
     * The policy was not opened or the controller was not set up, or it was moved since.
     */
    LADS_STATUS_NOT_SET_UP = 6,
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
     * The workspace is smaller than the policy needs.
     */
    LADS_STATUS_WORKSPACE_TOO_SMALL = 20,
    /**
     * The policy does not know this instruction.
     */
    LADS_STATUS_UNKNOWN_INSTRUCTION = 30,
    /**
     * The words are none, too many, or no whole number of word embeddings.
     */
    LADS_STATUS_WORDS_LENGTH = 31,
    /**
     * A word element is not finite.
     */
    LADS_STATUS_WORDS_NOT_FINITE = 32,
    /**
     * The instruct program failed; there is no instruction now.
     */
    LADS_STATUS_INSTRUCT_FAILED = 33,
    /**
     * The contract has no element of this number.
     */
    LADS_STATUS_NO_ELEMENT = 34,
    /**
     * No instruction has been set.
     */
    LADS_STATUS_NO_INSTRUCTION = 40,
    /**
     * The observation has another length than the contract's.
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
     * The self-test chose another plan than recorded.
     */
    LADS_STATUS_SELF_TEST_PLAN = 52,
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
     * A flag or a fallback has no meaning.
     */
    LADS_STATUS_UNKNOWN_OPTION = 70,
    /**
     * The limits of an action element leave nothing of the contract's range.
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
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum lads_status lads_status;
#else
typedef int32_t lads_status;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/**
 * A controller with its guard, at the start of its workspace. Private.
 */
typedef struct lads_controller lads_controller;

/**
 * An open policy: a checked view on a program image, in memory of the caller. Its content is private; it may not be moved or
 * copied after it was opened, and the image has to stay where it is, unchanged, as long as the policy is used.
 */
typedef struct lads_policy {
    /**
     * Private.
     */
    uint64_t private_words[LADS_POLICY_WORDS];
} lads_policy;

/**
 * Characters in UTF-8, without a zero at the end: print them with "%.*s", (int)text.len, text.data.
 */
typedef struct lads_text {
    /**
     * The first character; never null.
     */
    const char *data;
    /**
     * Bytes.
     */
    size_t len;
} lads_text;

/**
 * What a policy expects and promises.
 */
typedef struct lads_contract {
    /**
     * Environment, for example "franka-kitchen".
     */
    struct lads_text environment;
    /**
     * The environment's version.
     */
    struct lads_text environment_version;
    /**
     * SHA-256 of the bundle that the image was compiled from, hexadecimal.
     */
    struct lads_text bundle_sha256;
    /**
     * Language encoder that made the word embeddings.
     */
    struct lads_text encoder;
    /**
     * SHA-256 of its weights, hexadecimal.
     */
    struct lads_text encoder_sha256;
    /**
     * Time from one control step to the next, in seconds.
     */
    float control_period_s;
    /**
     * Control steps from one decision to the next.
     */
    uint32_t horizon;
    /**
     * Entries of the codebook, that is, plans.
     */
    uint32_t codebook_len;
    /**
     * Elements of an observation.
     */
    size_t observation_len;
    /**
     * Elements of an action.
     */
    size_t action_len;
    /**
     * The most words of an instruction.
     */
    size_t words_len;
    /**
     * Elements of a word embedding.
     */
    size_t word_dim;
    /**
     * Instructions that the policy knows by number.
     */
    uint32_t instruction_count;
    /**
     * Control steps that a context holds.
     */
    uint32_t context_steps;
    /**
     * Bytes of the image; what lies behind them is not read.
     */
    size_t image_bytes;
} lads_contract;

/**
 * One element of an observation or an action.
 */
typedef struct lads_element {
    /**
     * Name.
     */
    struct lads_text name;
    /**
     * Unit, "1" for none.
     */
    struct lads_text unit;
    /**
     * Joint that it belongs to; empty for none.
     */
    struct lads_text joint;
    /**
     * Smallest value, in the unit.
     */
    float min;
    /**
     * Largest value, in the unit.
     */
    float max;
} lads_element;

/**
 * One instruction that a policy knows.
 */
typedef struct lads_instruction {
    /**
     * Short name.
     */
    struct lads_text id;
    /**
     * What the person says.
     */
    struct lads_text text;
    /**
     * Sub-tasks, separated by commas.
     */
    struct lads_text sub_tasks;
    /**
     * Words.
     */
    size_t words_len;
} lads_instruction;

/**
 * How the guard works. All zero (`lads_options options = {0};`) is a guard with the contract's limits and no rate that stops at
 * the first fault. The lists have `action_len` elements and are copied; null stands for the default.
 */
typedef struct lads_options {
    /**
     * `LADS_ARM_WITHOUT_SELF_TEST`, `LADS_PORTABLE_INSTRUCTIONS`, or both.
     */
    uint32_t flags;
    /**
     * What to do when the policy's action cannot be used: `LADS_FALLBACK_STOP`, `_HOLD` or `_DECAY`.
     */
    uint32_t fallback;
    /**
     * Time constant of the decay, in seconds.
     */
    float decay_s;
    /**
     * Missed control periods that are still tolerated between two steps.
     */
    uint32_t late_after;
    /**
     * Stops after so many interventions in a row; 0 for never.
     */
    uint32_t stop_after;
    /**
     * Smallest actions, where the contract's are not narrower.
     */
    const float *min;
    /**
     * Largest actions, where the contract's are not narrower.
     */
    const float *max;
    /**
     * Largest change, in units of the action per second.
     */
    const float *max_rate;
    /**
     * Where the stop and the decay lead, and where the first action starts from.
     */
    const float *safe_action;
} lads_options;

/**
 * What a self-test that passed has measured.
 */
typedef struct lads_self_test_t {
    /**
     * Control steps replayed.
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
} lads_self_test_t;

/**
 * The clock of one control period.
 */
typedef struct lads_tick {
    /**
     * When the observation was taken, in any unit. One that is not later than the last one is stale.
     */
    uint64_t timestamp;
    /**
     * Control periods that have passed without a step since the last one.
     */
    uint32_t missed;
} lads_tick;

/**
 * What happened in a control period.
 */
typedef struct lads_report {
    /**
     * What `lads_step` returned.
     */
    int32_t status;
    /**
     * 1 when the policy took a step; the next four are 0 otherwise.
     */
    uint32_t stepped;
    /**
     * Control steps since the context began.
     */
    uint32_t timestep;
    /**
     * The plan in force: an index into the codebook.
     */
    uint32_t plan;
    /**
     * 1 when this step decided the plan, else 0.
     */
    uint32_t decided;
    /**
     * The largest logit of the last decision minus the second largest.
     */
    float margin;
    /**
     * 1 when an element of the action was at a limit or beyond and is now at the limit.
     */
    uint32_t saturated;
    /**
     * 1 when an element of the action moves as fast as it may, less far than it should.
     */
    uint32_t rate_limited;
} lads_report;

/**
 * What a guard has done since the controller was set up, in control periods. `policy` to `refused` add up to `periods`.
 */
typedef struct lads_counters_t {
    /**
     * All.
     */
    uint64_t periods;
    /**
     * With the policy's action.
     */
    uint64_t policy;
    /**
     * Before arming.
     */
    uint64_t not_armed;
    /**
     * While stopped.
     */
    uint64_t stopped;
    /**
     * Without an observation.
     */
    uint64_t no_observation;
    /**
     * With a stale observation.
     */
    uint64_t stale;
    /**
     * In which too many periods had been missed.
     */
    uint64_t late;
    /**
     * With an observation that was not finite.
     */
    uint64_t not_finite;
    /**
     * With an observation outside the contract's limits.
     */
    uint64_t out_of_limits;
    /**
     * That the controller refused for another reason: no instruction, a full context, a wrong length.
     */
    uint64_t refused;
    /**
     * Missed periods.
     */
    uint64_t missed;
    /**
     * With an action at a limit.
     */
    uint64_t saturated;
    /**
     * With an action that the rate held back.
     */
    uint64_t rate_limited;
} lads_counters_t;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * `LADS_ABI_VERSION` of the archive: compare it with the header's.
 */
uint32_t lads_abi_version(void);

/**
 * One line in English for a status; never null. The text is static and ends with a zero.
 */
const char *lads_status_text(int32_t status);

/**
 * Opens a program image: checks all of it, its checksum included, and copies nothing. The image is aligned to 4 bytes (64 is
 * better); bytes behind its own length are ignored. After a failure `policy` holds no policy.
 *
 * # Safety
 * `image` points to `image_bytes` readable bytes that do not change as long as the policy or a controller of it is used;
 * `policy` may be written, and stays where it is.
 */
lads_status lads_policy_open(const uint8_t *image,
                             size_t image_bytes,
                             struct lads_policy *policy);

/**
 * Tells what a policy expects and promises. The texts live as long as the image.
 *
 * # Safety
 * `policy` is null or a `lads_policy`, zeroed or opened; `contract` may be written.
 */
lads_status lads_policy_contract(const struct lads_policy *policy, struct lads_contract *contract);

/**
 * Tells about element `index` of an observation: name, unit, joint, limits.
 *
 * # Safety
 * As `lads_policy_contract`.
 */
lads_status lads_policy_observation(const struct lads_policy *policy, size_t index, struct lads_element *element);

/**
 * Tells about element `index` of an action: name, unit, joint, limits.
 *
 * # Safety
 * As `lads_policy_contract`.
 */
lads_status lads_policy_action(const struct lads_policy *policy, size_t index, struct lads_element *element);

/**
 * Tells about an instruction that the policy knows, by its number.
 *
 * # Safety
 * As `lads_policy_contract`.
 */
lads_status lads_policy_instruction(const struct lads_policy *policy,
                                    uint32_t number,
                                    struct lads_instruction *instruction);

/**
 * Finds the number of the instruction with this id, or of the first with this text, up to the case of ASCII letters and white space.
 *
 * # Safety
 * As `lads_policy_contract`; `name` points to `name_len` bytes, no zero needed; `number` may be written.
 */
lads_status lads_policy_find_instruction(const struct lads_policy *policy,
                                         const char *name,
                                         size_t name_len,
                                         uint32_t *number);

/**
 * Bytes of workspace for one controller of a policy; 0 when the policy was not opened.
 *
 * # Safety
 * `policy` is null or a `lads_policy`, zeroed or opened.
 */
size_t lads_workspace_bytes(const struct lads_policy *policy);

/**
 * Sets up a controller with its guard in `workspace`, aligned to `LADS_WORKSPACE_ALIGN`, which need not be initialised.
 * `options` may be null; so may `controller`, the handle for the other functions, which is the address of the workspace. It is
 * not armed unless `LADS_ARM_WITHOUT_SELF_TEST` is set. To end it, stop using it: nothing has to be undone.
 *
 * # Safety
 * `policy` is null or a `lads_policy`, zeroed or opened; `workspace` points to `workspace_bytes` writable bytes that nobody
 * else uses or moves as long as the controller is used; lists in the options are as long as an action; `controller` is null or
 * may be written.
 */
lads_status lads_controller_init(const struct lads_policy *policy,
                                 void *workspace,
                                 size_t workspace_bytes,
                                 const struct lads_options *options,
                                 struct lads_controller **controller);

/**
 * Replays the recorded episode, compares plans and actions, and arms the controller if it passes, disarms it if not. Afterwards
 * there is no instruction. `result`, which may be null, gets what a test that passed has measured.
 *
 * # Safety
 * `controller` is null or a workspace, zeroed or set up by `lads_controller_init`, and no other call uses it now;
 * `result` is null or may be written.
 */
lads_status lads_self_test(struct lads_controller *controller,
                           struct lads_self_test_t *result);

/**
 * Follows a known instruction, by its number, from the next step on: a new episode. `LADS_STATUS_INSTRUCT_FAILED`, which a sound image
 * never causes, leaves the controller without an instruction.
 *
 * # Safety
 * As `lads_self_test`.
 */
lads_status lads_set_instruction(struct lads_controller *controller,
                                 uint32_t number);

/**
 * Follows an instruction given as word embeddings, `len = n * word_dim` elements, as `lads_set_instruction` does.
 *
 * # Safety
 * As `lads_self_test`; `words` points to `len` readable elements outside the workspace.
 */
lads_status lads_set_words(struct lads_controller *controller, const float *words, size_t len);

/**
 * Picks plans by argmax (`temperature` not above 0) or at random with the softmax of the logits over the temperature.
 *
 * # Safety
 * As `lads_self_test`.
 */
lads_status lads_set_decision(struct lads_controller *controller, float temperature, uint64_t seed);

/**
 * One control period: writes an action that is finite and inside limits and rates, whatever the observation is. `LADS_STATUS_OK` says
 * that it is the policy's; any other status why it is the fallback's. A null `observation` says that there is none. `tick` may
 * be null, then nothing is stale or late; so may `report`.
 *
 * Only when the call itself is wrong, nothing happens and nothing is written: `controller` not set up, `action` of another
 * length than the contract's, null or overlapping the workspace, `tick` or `report` misaligned.
 *
 * # Safety
 * As `lads_self_test`; `observation` and `action` point to as many elements as they say; `tick` and `report` are null or may
 * be read and written.
 */
lads_status lads_step(struct lads_controller *controller,
                      const float *observation,
                      size_t observation_len,
                      const struct lads_tick *tick,
                      float *action,
                      size_t action_len,
                      struct lads_report *report);

/**
 * Tells what was really executed since the last step, where that is not the action that `lads_step` wrote; the next step
 * continues from there.
 *
 * # Safety
 * As `lads_self_test`; `action` points to `action_len` readable elements outside the workspace.
 */
lads_status lads_executed(struct lads_controller *controller,
                          const float *action,
                          size_t action_len);

/**
 * Starts a new episode with the same instruction. A stop stays a stop.
 *
 * # Safety
 * As `lads_self_test`.
 */
lads_status lads_reset(struct lads_controller *controller);

/**
 * Brings code, weights and KV cache into the processor's caches, so that the next step is as fast as the ones after it: for right
 * before the first step, or after a pause. Costs about two control steps and changes nothing.
 *
 * # Safety
 * As `lads_self_test`.
 */
lads_status lads_warm(struct lads_controller *controller);

/**
 * Stops as `LADS_FALLBACK_STOP` does, from the next step on.
 *
 * # Safety
 * As `lads_self_test`.
 */
lads_status lads_stop(struct lads_controller *controller);

/**
 * Ends a stop. The episode goes on where it was; `lads_reset` starts a new one.
 *
 * # Safety
 * As `lads_self_test`.
 */
lads_status lads_resume(struct lads_controller *controller);

/**
 * Tells what the guard has done since the controller was set up.
 *
 * # Safety
 * As `lads_self_test`; `counters` may be written.
 */
lads_status lads_counters(struct lads_controller *controller, struct lads_counters_t *counters);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* LADS_H */
