/* orthocas_runtime.h: what orthocas_runtime.c offers to a generated library, and what a library has to give it.
 *
 * The text of the runtime is the same for all robots, charts and laws. A generated library, NAME.c, holds tables and
 * kernels, describes them in one constant `orthocas_arm`, and passes calls on. The runtime has no global variables, no
 * heap, no input and no output; sizes are known at run time only, so callers also give it room for numbers, `work`.
 * SI units throughout, radians, matrices row by row.
 */
#ifndef ORTHOCAS_RUNTIME_H
#define ORTHOCAS_RUNTIME_H

/* NAME.c includes orthocas_runtime.c with ORTHOCAS_API defined as static: a library is one translation unit, exports no
 * names of the runtime, and compilers see the constants of its arm. Without a law, ORTHOCAS_CHART_ONLY is defined. */
#ifndef ORTHOCAS_API
#define ORTHOCAS_API
#endif

/* Statuses and modes, as NAME_status and NAME_mode. */
enum {
  ORTHOCAS_OK = 0,
  ORTHOCAS_OUTSIDE_DOMAIN = 1,
  ORTHOCAS_SINGULAR = 2,
  ORTHOCAS_NOT_FINITE = 3,
  ORTHOCAS_SATURATED = 4,
  ORTHOCAS_NEAR_BOUNDARY = 5,
  ORTHOCAS_CAUGHT = 6,
  ORTHOCAS_RETURNING = 7,
  ORTHOCAS_BAD_INPUT = 8,
  ORTHOCAS_TOO_FAST = 9,
  ORTHOCAS_LATE = 10,
  ORTHOCAS_HELD = 11,
  ORTHOCAS_STOPPED_EARLY = 12,
  ORTHOCAS_LOAD_MISMATCH = 13,
  ORTHOCAS_TOUCHED = 14
};
enum { ORTHOCAS_LAW = 0, ORTHOCAS_CATCHER = 1, ORTHOCAS_RETURN = 2, ORTHOCAS_HOLD = 3 };

/* Values of the controlled quantities with two derivatives: places of k numbers each, one after the other. */
typedef struct {
  double *value, *velocity, *acceleration;
} orthocas_reference;

/* Functions of one robot, chart and law. Gains are a NAME_gains. Those that a library lacks are null. */
typedef struct {
  void (*chart)(const double *q, double *phi, double *jacobian);
  void (*curvature)(const double *q, const double *dq, const double *v, double *curvature);
  void (*dynamics)(const double *q, const double *dq, double *mass_matrix, double *bias, double *gravity);
  /* Errors e and their Jacobian (n, n), rooms of conditions, > 0 inside, and theirs (rooms, n), column by column. */
  void (*near)(const double *q, const double *wanted, double *e, double *slopes, double *rooms, double *inwards);
  /* Orientations of x: the turn (m,) that is left, and the rates of x (m, n). */
  void (*turned)(const double *q, const double *phi, const double *wanted, double *left, double *rates);
  /* Whether the condition of the domain holds beside its box. */
  int (*is_clear)(const double *q);

  /* What the following three share of a state. */
  void (*shared)(const double *q, const double *dq, double *shared);
  int (*control)(const double *shared, const double *q, const double *dq, const orthocas_reference *reference,
                 const void *gains, double *command);
  /* Controlled quantities, and how far they are from a value (k,). */
  void (*deviation)(const double *shared, const double *q, const double *value, double *measured, double *error);
  /* A (n, n) and B (n, 3): A^-1 B is how joints follow a change of the reference, its velocity and acceleration. */
  void (*implied)(const double *shared, const double *q, const double *dq, const orthocas_reference *reference,
                  const double *change, double *A, double *B);
  void (*fallback)(const double *q, const void *gains, double *command);
  /* From a reference to a value (k,), and the rates of the reference as errors count. */
  void (*gap)(const orthocas_reference *from, const double *to, double *way, double *rate, double *change);
  /* Orientations turn instead of adding up: (m,) each. */
  void (*moved)(const double *from, const double *step, const orthocas_reference *reference, double *value,
                double *velocity, double *acceleration);
  void (*turned_by)(const double *from, const double *way, const double *velocity, const double *acceleration,
                    const orthocas_reference *to);
  /* What a law remembers after a tick, and what of that its gains get. */
  void (*remember)(const double *q, const double *dq, const orthocas_reference *reference, const void *gains,
                   const double *command, double active, double period, const double *last, double *memory);
  void (*add_memory)(const double *memory, void *gains);
  /* J J^T (m, m) of the task, scaled, and the volume of the coordinates, in shares of the median. */
  void (*gram)(const double *q, double *gram);
  double (*room_to_fold)(const double *q);
  /* NAME_distance: how far links are apart. */
  int (*gap_of_links)(const double *q, double *gap, double *gradient, double *points, int *pair);
} orthocas_kernels;

/* A part of the boundary beside the box, for supervision. None: lines and span are 0. */
typedef struct {
  int counted;               /* corridors: joints in which distances to the path count, and these */
  int lines;                 /* of the path, from posture to posture */
  const int *joints;
  const double *radius;      /* (counted,) [rad] or [m] */
  const double *line_start;  /* (lines, counted), in radii */
  const double *line_axis;   /* (lines, counted), of length 1 */
  const double *line_length; /* (lines,), in radii */
  double bound, span;        /* of the relative singular value of the task, and from there to the centre's */
} orthocas_boundary;

/* What depends on the number type. */
typedef struct {
  double largest;  /* larger numbers count as not finite: their squares may overflow */
  double smallest; /* positive, to divide by */
  double farthest; /* larger positions count as not finite, because they are too coarse [rad] or [m] */
  double rounding; /* of references: slower ones may stand still */
  double solved;   /* largest |phi(q) - phi| of a solution, in sizes of the components */
  double exact;    /* error at which the search for a better solution stops */
  double coarse;   /* share of a wanted value that counts as size, so that `solved` of it is not below rounding */
  double pivot;    /* smaller ones are singular */
} orthocas_numbers;

/* Rules of the descent to the nearest position. */
typedef struct {
  double damping, least_damping; /* of its first step, relative to the error of x; and at least */
  double grows, shrinks;         /* factors of the damping after bad and good steps */
  double decrease;               /* share of the promised gain that a good step brings */
  double converged;              /* relative gain below which a position is a minimum */
  double room, still;            /* least room of conditions; slower directions stand still */
  int corrections, evaluations;  /* of one step, of one call */
} orthocas_reaching;

/* One robot with its chart and law. */
typedef struct {
  int n, m, k;                           /* joints, task components, controlled quantities */
  int rooms;                             /* conditions of the domain that `near` gives, at least 1 */
  const double *lower, *upper;           /* domain (n,) */
  const double *centre, *half_width;     /* of the domain (n,) */
  const double *reach;                   /* distance from the centre to the bounds, which belong to the domain (n,) */
  const double *phi_size;                /* how far a component moves over the domain (n,) */
  const double *phi_turn, *phi_rounds;   /* periods of angles and their inverses (n,), 0: none; null without angles */
  orthocas_numbers numbers;
  orthocas_reaching reaching;
  orthocas_kernels kernels;

  int torque;                            /* whether commands are torques, not velocities */
  double integral_bound;                 /* of the rate of integral action that the slowest mode bears [1/s] */
  int shared, memory;                    /* numbers of `shared`, and of NAME_memory */
  int memory_torque;                     /* where NAME_memory has a torque (n,) that the first command shows; or -1 */
  int turned_first, turned_end;          /* components of x that are an orientation; equal: none */
  double contact_margin;                 /* what links keep of each other [m] */
  const int *bounded, *turning;          /* joints with boundaries of the domain; joints that turn without end (n,) */
  const double *unit;                    /* of distances to the boundaries (n,) */
  const double *turns;                   /* periods of joints in NAME_control (n,), 0: none; null: no joint turns */
  const double *memory_start;            /* (memory,) */
  const void *default_gains;             /* NAME_gains */
  const double *default_limit;           /* its limit (n,) */
  orthocas_boundary boundary;
} orthocas_arm;

/* Settings, as in NAME_safety, which says what they mean. */
typedef struct {
  const double *command_rate, *speed_limit, *rest_speed, *stuck_speed;            /* (n,) */
  const double *reference_speed, *reference_acceleration, *start_mismatch;        /* (n,) */
  const double *friction, *encoder_step, *contact_torque;                         /* (n,), null for velocity laws */
  const double *lower, *upper, *stop_stiffness;                                   /* (n,) */
  const double *observer_rate, *stop_zone, *stop_damping, *brake_yield;           /* (n,), null for velocity laws */
  const double *error_limit, *offset_rate, *integral_rate, *integral_limit;       /* (k,) */
  double near_margin, catch_margin, return_margin, fade_in, fade_out, return_speed, longest_period, damping;
  double brake_stiffness, energy_limit, energy_rate; /* torque laws */
  int hold_ticks, stale_ticks;
} orthocas_safety;

/* The state of a supervised law: counters and weights of a NAME_state, and where its arrays are. */
typedef struct {
  int mode, cause;
  int asked, bad_ticks, fresh, stale_ticks, same_ticks;
  double weight, brake, unseen, hasty, energy;
  double *q, *dq, *seen_q, *seen_dq, *command, *led, *impulse, *impulse_from, *law, *anchor, *safe, *limit; /* (n,) */
  double *offset, *integral;                                                                                /* (k,) */
  double *load, *drive, *speed, *expected, *unexplained, *momentum, *trend, *touch, *carried, *apart, *gone, *same_q, *same_dq; /* (n,), null for velocity laws */
  double *inertia;                                                           /* (n, n), null for velocity laws */
  double *memory;                                                            /* (memory,) or null */
  orthocas_reference reference;
  const orthocas_safety *safety;
} orthocas_state;

/* Gains of a tick. */
typedef struct {
  const void *given;          /* NAME_gains of the program */
  void *used;                 /* a copy, with the limit that holds and what the law remembers */
  const double *given_limit;  /* (n,) */
  double *limit;              /* of the copy (n,) */
  const double *extra_torque; /* (n,), for laws whose memory has a torque */
} orthocas_gains;

/* Numbers and integers of `work` that functions need at most. */
#define ORTHOCAS_INVERSE_WORK(n) ((n) * ((n) + 7))
#define ORTHOCAS_NEAREST_WORK(n, rooms)                                                                               \
  (5 * (n) * (n) + 14 * (n) + 4 * (rooms) + 3 * (n) * (rooms) + (2 * (n) + (rooms)) * (2 * (n) + (rooms) + 1))
#define ORTHOCAS_NEAREST_HELD(n, rooms) ((n) + (rooms))
#define ORTHOCAS_LAW_WORK(n, k, shared, memory) (3 * (n) * (n) + 10 * (n) + 9 * (k) + (shared) + (memory))

/* Of phi, in searches without a bound of the caller. */
#define ORTHOCAS_EVALUATIONS 100

/* Chart, dynamics, inverse map: see NAME_chart, NAME_chart_curvature, NAME_dynamics, NAME_inverse, NAME_nearest. */
ORTHOCAS_API int orthocas_chart(const orthocas_arm *arm, const double *q, double *phi, double *jacobian);
ORTHOCAS_API int orthocas_curvature(const orthocas_arm *arm, const double *q, const double *dq, const double *v,
                                    double *curvature);
ORTHOCAS_API int orthocas_dynamics(const orthocas_arm *arm, const double *q, const double *dq, double *mass_matrix,
                                   double *bias, double *gravity);
ORTHOCAS_API int orthocas_inverse(const orthocas_arm *arm, const double *phi, const double *q_start, int max_iterations,
                                  double *q, double *work);
ORTHOCAS_API int orthocas_nearest(const orthocas_arm *arm, const double *phi, const double *q_start, double largest_step,
                                  double *q, double *work, int *held);

#ifndef ORTHOCAS_CHART_ONLY
/* The law without supervision: see NAME_control. */
ORTHOCAS_API int orthocas_control(const orthocas_arm *arm, const double *q, const double *dq,
                                  const orthocas_reference *reference, const void *gains, double *command, double *work);

/* The supervised law: see NAME_check_start to NAME_step. A state begins as zeros with the default settings. */
ORTHOCAS_API int orthocas_check_settings(const orthocas_arm *arm, const orthocas_safety *safety);
ORTHOCAS_API int orthocas_check_start(const orthocas_arm *arm, const orthocas_safety *safety, const double *q,
                                      const double *torque, const void *gains, double *mismatch, double *work);
ORTHOCAS_API void orthocas_begin(const orthocas_arm *arm, orthocas_state *state, int mode, const double *q,
                                 const double *command, double *work);
ORTHOCAS_API void orthocas_resume(orthocas_state *state);
ORTHOCAS_API void orthocas_stand(const orthocas_arm *arm, orthocas_state *state, int mode, const double *q,
                                 const double *command);
ORTHOCAS_API int orthocas_step(const orthocas_arm *arm, orthocas_state *state, int set, const double *q,
                               const double *dq, const orthocas_reference *reference, const orthocas_gains *gains,
                               double period, double *command, double *work);

/* References: see NAME_reference_at to NAME_reference_pace. */
ORTHOCAS_API void orthocas_reference_at(const orthocas_arm *arm, const double *q, const orthocas_reference *reference,
                                        double *work);
ORTHOCAS_API int orthocas_reference_stream(const orthocas_arm *arm, const double *q, const double *dq,
                                           const orthocas_safety *safety, const orthocas_reference *reference,
                                           const double *target, double omega, double period, double *work);
ORTHOCAS_API int orthocas_reference_spline(const orthocas_arm *arm, const orthocas_reference *from, const double *target,
                                           double duration, double time, const orthocas_reference *reference,
                                           double *work);
ORTHOCAS_API double orthocas_reference_pace(const orthocas_arm *arm, const double *q, const double *dq,
                                            const double *led, const orthocas_safety *safety,
                                            const orthocas_reference *reference, double period, double *work);
#endif

#endif
